/* The whole test framework. A program is
 *
 *     static void test_something(void) { CONTEXT("scene %s", name); CHECK(a == b); CHECK_MSG(a == b, "a %d, b %d", a, b); }
 *     int main(int argc, char **argv) { test_start(argc, argv); RUN(test_something); return test_finish(); }
 *
 * and prints one line a failure (file:line, what was expected, the values, the context) and at the end exactly one line
 * "N passed, N failed". Arguments that do not start with '-' choose tests: those whose name contains one of them. */
#ifndef TEST_H
#define TEST_H

#include <stdarg.h>
#include <stdio.h>
#include <string.h>

#ifdef TRBVH_TEST_QUICK            /* smaller scenes and fewer rays: for sanitizers and valgrind */
  #define QUICK_OR(quick, full) (quick)
#else
  #define QUICK_OR(quick, full) (full)
#endif
#define TEST_SHOWN 8               /* failures of one test that are printed in full */

typedef struct test_state { int argc; char **argv; unsigned passed, failed, failures; char context[256]; } test_state;
static test_state test_now;

static inline void test_start(int argc, char **argv) { test_now.argc = argc; test_now.argv = argv; }

static inline void test_context(const char *format, ...)
{
  va_list list;
  va_start(list, format);
  vsnprintf(test_now.context, sizeof test_now.context, format, list);
  va_end(list);
}

static inline void test_fail(const char *file, int line, const char *condition, const char *format, ...)
{
  va_list list;
  if (++test_now.failures > TEST_SHOWN) return;
  printf("%s:%d: failed: %s", file, line, condition);
  va_start(list, format);
  if (format[0]) { printf(": "); vprintf(format, list); }
  va_end(list);
  printf("%s%s%s\n", test_now.context[0] ? " [" : "", test_now.context, test_now.context[0] ? "]" : "");
}

static inline void test_run(const char *name, void (*test)(void))
{
  int i, named = 0, wanted = 0;
  for (i = 1; i < test_now.argc; ++i)
    if (test_now.argv[i][0] != '-') { named = 1; wanted |= strstr(name, test_now.argv[i]) != NULL; }
  if (named && !wanted) return;
  test_now.failures = 0;
  test_now.context[0] = 0;
  test();
  if (test_now.failures) printf("FAILED %s: %u checks\n", name, test_now.failures);
  if (test_now.failures) ++test_now.failed; else ++test_now.passed;
  fflush(stdout);
}

static inline int test_finish(void)
{
  printf("%u passed, %u failed\n", test_now.passed, test_now.failed);
  return test_now.failed || !test_now.passed;
}

#define CHECK(condition)          do { if (!(condition)) test_fail(__FILE__, __LINE__, #condition, "%s", ""); } while (0)
#define CHECK_MSG(condition, ...) do { if (!(condition)) test_fail(__FILE__, __LINE__, #condition, __VA_ARGS__); } while (0)
#define CONTEXT(...)              test_context(__VA_ARGS__)
#define RUN(test)                 test_run(#test, test)

#endif
