/* embed.c - writes the OpenCL C text into trbvh_cl.h: the core of trbvh.h, and the kernels that stand beside this
 * file. So the backend is a header like the other, and reads no file when it runs. In the project's root folder:
 *
 *     cc -o embed kernels/embed.c && ./embed .            after every change of trbvh.h or of a kernel
 *     ./embed --check .                                   compares only: exit status 1 where that was forgotten
 *
 * The text replaces what is between the lines "// >>kernels begin" and "// >>kernels end": an array of strings, one a
 * source line, as C99 grants a literal no more than 4095 characters. It is what an OpenCL C compiler makes of the
 * sources: no comments, includes, or branches for C; #line keeps its messages true. Errors: exit status 2. */
#include <ctype.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static const struct { const char *name, *guard; } sources[] = {
  { "trbvh.h", NULL }, { "kernels/query.cl", NULL },                    /* the core: for users' kernels, too */
  { "kernels/shape.cl",     "#ifdef TRB_WITH_SHAPE" },
  { "kernels/bounds.cl",    "#ifdef TRB_WITH_BOUNDS" },
  { "kernels/split.cl",     "#ifdef TRB_WITH_SPLIT" },
  { "kernels/morton.cl",    "#ifdef TRB_WITH_MORTON" },
  { "kernels/sort.cl",      "#ifdef TRB_WITH_SORT" },
  { "kernels/hierarchy.cl", "#ifdef TRB_WITH_HIERARCHY" },
  { "kernels/treelets.cl",  "#ifdef TRB_WITH_TREELETS" },
  { "kernels/moves.cl",     "#ifdef TRB_WITH_MOVES" },
  { "kernels/collapse.cl",  "#ifdef TRB_WITH_COLLAPSE" },
  { "kernels/output.cl",    "#ifdef TRB_WITH_OUTPUT" },
  { "kernels/refit.cl",     "#ifdef TRB_WITH_REFIT" },
  { "kernels/trace.cl",     "#ifdef TRB_WITH_TRACE" },
};
#define COUNT(array) ((int)(sizeof(array) / sizeof(array)[0]))

static const char *file;                 /* being read or written, and the line there, 0 = none: for messages */
static unsigned line;

static void fail(const char *what) {
  fprintf(stderr, "embed: %s:", file);
  if (line) fprintf(stderr, "%u:", line);
  fprintf(stderr, " %s\n", what);
  exit(2);
}

// ---- Output: the new trbvh_cl.h ----
static char *output;
static size_t size, room;
static unsigned entries;                 /* of the array */
static uint64_t hash = 14695981039346656037u;

static void put(const char *text, size_t length) {
  if (size + length >= room) output = (char *)realloc(output, room = 2 * (size + length) + 65536);
  if (!output) fail("no memory");
  memcpy(output + size, text, length);
  size += length;
  output[size] = 0;
}

static void print(const char *text) { put(text, strlen(text)); }

/* A line of the OpenCL C text. */
static void entry(const char *text) {
  const size_t start = size;
  print("  \"");
  do {
    const char c = *text ? *text : '\n';
    if (*text && (c < ' ' || c > '~')) fail("tab or non-ASCII character outside of comments");
    hash = (hash ^ (unsigned char)c) * 1099511628211u;
    if (strchr("\\\"\n", c) || (c == '?' && output[size - 1] == '?')) print("\\");     /* no trigraph */
    put(*text ? text : "n", 1);
  } while (*text++);
  print("\",\n");
  if (size - start > 4095) fail("line too long for C99");
  entries++;
}

// ---- Conditionals: those that OpenCL C decides are resolved, all others stay ----
enum { NO, MAYBE, YES };                 /* so that && is the lesser, || the greater, ! the difference from YES */
static const char *const names[] = { "__OPENCL_C_VERSION__", "TRBVH_OPENCL_C", "TRBVH_H", "TRBVH_IMPLEMENTED" };
static int defined[] = { YES, YES, NO, NO, MAYBE };   /* the last: any other name */

static char  *skip(char *s) { return s + strspn(s, " \t"); }
static size_t word(const char *s) { size_t n = 0; while (isalnum((unsigned char)s[n]) || s[n] == '_') n++; return n; }
static int    is(const char *s, const char *name) { return word(s) == strlen(name) && !memcmp(s, name, word(s)); }
static int    lookup(const char *s) { int i = 0; while (i < COUNT(names) && !is(s, names[i])) i++; return i; }

/* The value of alternatives (level 0), conjunctions (1) or operands (2) at *at, which moves behind them. */
static int condition(char **at, int level) {
  char *s = skip(*at);
  int value = MAYBE, nested = 0;
  if (level < 2) {
    value = condition(at, level + 1);
    while (!strncmp(*at, level ? "&&" : "||", 2)) {
      int next = (*at += 2, condition(at, level + 1));
      if (level ? next < value : next > value) value = next;
    }
    return value;
  }
  if (*s == '!' || *s == '(') {
    const char first = *s++;
    value = first == '!' ? YES - condition(&s, 2) : condition(&s, 0);
    s += first == '(' && *s == ')';
  } else if (is(s, "defined")) {
    char *open = skip(s + 7), *name = skip(open + (*open == '('));
    value = defined[lookup(name)];
    s = skip(name + word(name));
    s += *open == '(' && *s == ')';
  }
  for (s = skip(s); *s && (nested || (*s != ')' && strncmp(s, "&&", 2) && strncmp(s, "||", 2))); s = skip(s + 1)) {
    value = MAYBE;                                    /* arithmetic is not for us */
    nested += (*s == '(') - (*s == ')');
    if (*s == '\\') fail("this conditional should stand on one line");
  }
  *at = s;
  return value;
}

enum { KEEP, ON, OFF, DONE };            /* of a chain #if..#endif: unresolved; in its branch; before it; behind it */
static int state[32] = { ON }, depth;

static int enter(int value) { state[depth] = value == YES ? ON : value == NO ? OFF : KEEP; return value == MAYBE; }

/* Does this line belong to the text? */
static int wanted(char *s) {
  const int was = state[depth], active = was <= ON;
  char *rest;
  if (*(s = skip(s)) != '#') return active;
  s = skip(s + 1);
  rest = skip(s + word(s));
  if (is(s, "if") || is(s, "ifdef") || is(s, "ifndef")) {
    if (++depth == COUNT(state)) fail("conditionals too deep");
    state[depth] = DONE;                              /* in a dropped branch, all of them are */
    if (!active) return 0;
    if (is(s, "if")) return enter(condition(&rest, 0));
    return enter(is(s, "ifdef") ? defined[lookup(rest)] : YES - defined[lookup(rest)]);
  }
  if (is(s, "elif") || is(s, "else") || is(s, "endif")) {
    if (!depth) fail("conditionals out of balance");
    if (is(s, "endif")) depth--;
    else if (was == ON) state[depth] = DONE;
    else if (was == OFF && is(s, "else")) state[depth] = ON;
    else if (was == OFF && enter(condition(&rest, 0))) return memcpy(s, "  if", 4), 1;   /* now it is the first */
    return was == KEEP;
  }
  if (is(s, "define") && active && defined[lookup(rest)] == NO) return defined[lookup(rest)] = YES, 0;   /* a guard */
  return active && !is(s, "include");
}

// ---- Sources ----
static FILE *open_file(const char *root, const char *name, const char *mode) {
  char path[1024];
  FILE *f;
  file = name;
  line = 0;
  if (snprintf(path, sizeof path, "%s/%s", root, name) >= (int)sizeof path) fail("path too long");
  f = fopen(path, mode);
  if (!f) fail("cannot be opened");
  return f;
}

/* Line ends are "\n" from here on. */
static char *load(const char *root, const char *name) {
  FILE *f = open_file(root, name, "rb");
  char *text = NULL, *to;
  const char *from;
  long bytes = fseek(f, 0, SEEK_END) ? -1 : ftell(f);
  if (bytes >= 0) text = (char *)calloc((size_t)bytes + 1, 1);
  if (!text || fseek(f, 0, SEEK_SET) || fread(text, 1, (size_t)bytes, f) != (size_t)bytes) fail("cannot be read");
  fclose(f);
  for (from = to = text; *from; from++) if (from[0] != '\r' || from[1] != '\n') *to++ = *from;
  *to = 0;
  return text;
}

/* Comments become a space and the line ends in them. */
static void strip_comments(char *text) {
  const char *s = text;
  char *to = text;
  while (*s) {
    if (s[0] == '/' && s[1] == '/') s += strcspn(s, "\n");
    else if (s[0] == '/' && s[1] == '*') {
      const char *end = strstr(s + 2, "*/");
      if (!end) fail("comment without an end");
      for (*to++ = ' '; s < end + 2; s++) if (*s == '\n') *to++ = '\n';
    } else if (*s == '"' || *s == '\'') {
      const char quote = *s;
      do { if (*s == '\\' && s[1]) *to++ = *s++; *to++ = *s++; } while (*s && *s != quote && *s != '\n');
      if (*s == quote) *to++ = *s++;
    } else *to++ = *s++;
  }
  *to = 0;
}

static void embed(const char *root, const char *name) {
  char *text = load(root, name), place[128], *s, *next;
  unsigned expected = 0;                 /* the line number that a compiler gives the next entry */
  int continued = 0;
  strip_comments(text);
  for (s = text, line = 1; *s; s = next, line++) {
    char *end = s + strcspn(s, "\n");
    int keep;
    next = end + (*end == '\n');
    while (end > s && strchr(" \t", end[-1])) end--;
    *end = 0;
    keep = continued ? state[depth] <= ON : wanted(s);
    continued = end > s && end[-1] == '\\';
    if (continued && strchr("\n", *skip(next))) fail("continues into an empty line");   /* a #line could follow */
    if (!keep || end == s) continue;
    if (!expected || line > expected + 3) {
      snprintf(place, sizeof place, "#line %u \"%s\"", line, name);
      entry(place);
    } else while (expected++ < line) entry("");
    entry(s);
    expected = line + 1;
  }
  if (depth) fail("conditionals out of balance");
  free(text);
}

static char *find_line(char *text, const char *begins_with) {
  char *s = strstr(text, begins_with);
  while (s && s != text && s[-1] != '\n') s = strstr(s + 1, begins_with);
  if (!s) fail("lines \"// >>kernels begin\" and \"// >>kernels end\" expected");
  return s;
}

int main(int argc, char **argv) {
  const int check = argc > 1 && !strcmp(argv[1], "--check");
  const char *root = argc > 1 + check ? argv[1 + check] : ".";
  char text[512], *old, *begin, *end;
  unsigned core_entries = 0;
  int i, same;
  if (argc > 2 + check || root[0] == '-') return fputs("usage: embed [--check] [root folder]\n", stderr), 2;

  old = load(root, "trbvh_cl.h");
  begin = find_line(old, "// >>kernels begin");
  begin += strcspn(begin, "\n");
  end = find_line(begin, "// >>kernels end");

  put(old, (size_t)(begin - old));
  print("\nstatic const char *const trb_cl_text[] = {\n");
  for (i = 0; i < COUNT(sources); i++) {
    if (sources[i].guard) entry(sources[i].guard);
    embed(root, sources[i].name);
    if (sources[i].guard) entry("#endif");
    else core_entries = entries;
  }
  snprintf(text, sizeof text,
    "};\n"
    "#define TRB_CL_CORE_LINES %uu   /* entries of trb_cl_text for user kernels: types, core, traversal */\n"
    "#define TRB_CL_LINES      %uu   /* all entries */\n"
    "#define TRB_CL_HASH       \"%016llx\"   /* FNV-1a 64 of all strings: part of the program cache's key */\n",
    core_entries, entries, (unsigned long long)hash);
  print(text);
  print(end);

  same = !strcmp(old, output);
  if (check && !same) fputs("trbvh_cl.h is out of date, run: cc -o embed kernels/embed.c && ./embed .\n", stderr);
  if (!check && !same) {
    FILE *f = open_file(root, "trbvh_cl.h", "wb");
    if (fwrite(output, 1, size, f) != size || fclose(f) != 0) fail("cannot be written");
  }
  free(old);
  free(output);
  return check && !same;
}
