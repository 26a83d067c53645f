/* A stand-in for libOpenCL inside the test program, which is linked with -rdynamic: the functions here are found where
 * a program that uses OpenCL already has it, and forward to the real library. On the way they count calls and live
 * objects, note misuse that a forgiving implementation would let pass, and fail on demand: the n-th call, or all from
 * there on (a lost device). They can also hide platforms or devices, call any device a GPU, tell of little memory, or
 * refuse to compile. Needs no OpenCL headers: every handle is a void pointer here. Linux only.
 *
 * Below it: an application with a context, a queue and buffers of its own, none of them counted by the stub; and a cache
 * for compiled programs in memory. Include trbvh_cl.h, test.h and scenes.h first. */
#ifndef CL_STUB_H
#define CL_STUB_H

#include <dlfcn.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <time.h>

enum { STUB_CONTEXT, STUB_QUEUE, STUB_BUFFER, STUB_PROGRAM, STUB_KERNEL, STUB_EVENT, STUB_KINDS };
static const char *const stub_kinds[STUB_KINDS] = {"contexts", "queues", "buffers", "programs", "kernels", "events"};

enum {
  CL_NOT_FOUND = -1, CL_NO_MEMORY = -4, CL_NO_RESOURCES = -5, CL_NO_HOST_MEMORY = -6, CL_BUILD_FAILED = -11,
  CL_BAD_SIZE = -61, CL_NO_PLATFORM = -1001
};
enum {
  CL_TYPE_CPU = 2, CL_TYPE_GPU = 4,
  CL_DEVICE_TYPE = 0x1000, CL_DEVICE_MAX_ALLOC = 0x1010, CL_DEVICE_MEMORY = 0x101F, CL_QUEUE_REFERENCES = 0x1092,
  CL_CONTEXT_REFERENCES = 0x1080, CL_BUFFER_BYTES = 0x1102, CL_BUILD_LOG = 0x1183, CL_EVENT_STATUS = 0x11D3,
  CL_COPY_HOST = 1 << 5
};

/* X(what it does, with which kind of object, name, parameters, arguments):
 *   CALL     returns an error code and makes nothing           CREATE   returns a handle, the error code through error
 *   ENQUEUE  makes an event where one is asked for             RETAIN, RELEASE
 *   OWN      returns an error code, OWN_CREATE a pointer: written out below */
#define STUB_ASK     unsigned what, size_t size, void *out, size_t *needed
#define STUB_ASKED   what, size, out, needed
#define STUB_AFTER   unsigned waits, void *const *wait, void **event
#define STUB_AFTERS  waits, wait, event
#define STUB_LIST(X) \
  X(OWN, 0, clGetPlatformIDs, (unsigned size, void **out, unsigned *count), (size, out, count)) \
  X(CALL, 0, clGetPlatformInfo, (void *platform, STUB_ASK), (platform, STUB_ASKED)) \
  X(OWN, 0, clGetDeviceIDs, (void *platform, uint64_t type, unsigned size, void **out, unsigned *count), (platform, type, size, out, count)) \
  X(OWN, 0, clGetDeviceInfo, (void *device, STUB_ASK), (device, STUB_ASKED)) \
  X(CREATE, STUB_CONTEXT, clCreateContext, (const intptr_t *properties, unsigned count, void *const *devices, void (*notify)(const char *, const void *, size_t, void *), void *user, int *error), (properties, count, devices, notify, user, error)) \
  X(RETAIN, STUB_CONTEXT, clRetainContext, (void *object), (object)) \
  X(RELEASE, STUB_CONTEXT, clReleaseContext, (void *object), (object)) \
  X(CALL, 0, clGetContextInfo, (void *context, STUB_ASK), (context, STUB_ASKED)) \
  X(CREATE, STUB_QUEUE, clCreateCommandQueue, (void *context, void *device, uint64_t properties, int *error), (context, device, properties, error)) \
  X(RETAIN, STUB_QUEUE, clRetainCommandQueue, (void *object), (object)) \
  X(RELEASE, STUB_QUEUE, clReleaseCommandQueue, (void *object), (object)) \
  X(CALL, 0, clGetCommandQueueInfo, (void *queue, STUB_ASK), (queue, STUB_ASKED)) \
  X(OWN_CREATE, STUB_BUFFER, clCreateBuffer, (void *context, uint64_t flags, size_t size, void *host, int *error), (context, flags, size, host, error)) \
  X(RETAIN, STUB_BUFFER, clRetainMemObject, (void *object), (object)) \
  X(RELEASE, STUB_BUFFER, clReleaseMemObject, (void *object), (object)) \
  X(CALL, 0, clGetMemObjectInfo, (void *buffer, STUB_ASK), (buffer, STUB_ASKED)) \
  X(CREATE, STUB_PROGRAM, clCreateProgramWithSource, (void *context, unsigned count, const char **strings, const size_t *lengths, int *error), (context, count, strings, lengths, error)) \
  X(CREATE, STUB_PROGRAM, clCreateProgramWithBinary, (void *context, unsigned count, void *const *devices, const size_t *lengths, const unsigned char **binaries, int *status, int *error), (context, count, devices, lengths, binaries, status, error)) \
  X(OWN, 0, clBuildProgram, (void *program, unsigned count, void *const *devices, const char *options, void (*notify)(void *, void *), void *user), (program, count, devices, options, notify, user)) \
  X(CALL, 0, clGetProgramInfo, (void *program, STUB_ASK), (program, STUB_ASKED)) \
  X(OWN, 0, clGetProgramBuildInfo, (void *program, void *device, STUB_ASK), (program, device, STUB_ASKED)) \
  X(RELEASE, STUB_PROGRAM, clReleaseProgram, (void *object), (object)) \
  X(CREATE, STUB_KERNEL, clCreateKernel, (void *program, const char *name, int *error), (program, name, error)) \
  X(RELEASE, STUB_KERNEL, clReleaseKernel, (void *object), (object)) \
  X(CALL, 0, clSetKernelArg, (void *kernel, unsigned index, size_t size, const void *value), (kernel, index, size, value)) \
  X(CALL, 0, clGetKernelWorkGroupInfo, (void *kernel, void *device, STUB_ASK), (kernel, device, STUB_ASKED)) \
  X(OWN, STUB_EVENT, clEnqueueNDRangeKernel, (void *queue, void *kernel, unsigned dimensions, const size_t *offset, const size_t *global, const size_t *local, STUB_AFTER), (queue, kernel, dimensions, offset, global, local, STUB_AFTERS)) \
  X(OWN, STUB_EVENT, clEnqueueReadBuffer, (void *queue, void *buffer, unsigned blocking, size_t offset, size_t size, void *out, STUB_AFTER), (queue, buffer, blocking, offset, size, out, STUB_AFTERS)) \
  X(OWN, STUB_EVENT, clEnqueueWriteBuffer, (void *queue, void *buffer, unsigned blocking, size_t offset, size_t size, const void *in, STUB_AFTER), (queue, buffer, blocking, offset, size, in, STUB_AFTERS)) \
  X(ENQUEUE, STUB_EVENT, clEnqueueFillBuffer, (void *queue, void *buffer, const void *pattern, size_t pattern_size, size_t offset, size_t size, STUB_AFTER), (queue, buffer, pattern, pattern_size, offset, size, STUB_AFTERS)) \
  X(ENQUEUE, STUB_EVENT, clEnqueueCopyBuffer, (void *queue, void *from, void *to, size_t from_offset, size_t to_offset, size_t size, STUB_AFTER), (queue, from, to, from_offset, to_offset, size, STUB_AFTERS)) \
  X(OWN_CREATE, STUB_EVENT, clEnqueueMapBuffer, (void *queue, void *buffer, unsigned blocking, uint64_t flags, size_t offset, size_t size, STUB_AFTER, int *error), (queue, buffer, blocking, flags, offset, size, STUB_AFTERS, error)) \
  X(OWN, STUB_EVENT, clEnqueueUnmapMemObject, (void *queue, void *buffer, void *mapped, STUB_AFTER), (queue, buffer, mapped, STUB_AFTERS)) \
  X(ENQUEUE, STUB_EVENT, clEnqueueMarkerWithWaitList, (void *queue, STUB_AFTER), (queue, STUB_AFTERS)) \
  X(ENQUEUE, STUB_EVENT, clEnqueueBarrierWithWaitList, (void *queue, STUB_AFTER), (queue, STUB_AFTERS)) \
  X(CALL, 0, clFlush, (void *queue), (queue)) \
  X(OWN, 0, clFinish, (void *queue), (queue)) \
  X(OWN, 0, clWaitForEvents, (unsigned count, void *const *events), (count, events)) \
  X(CALL, 0, clGetEventInfo, (void *object, STUB_ASK), (object, STUB_ASKED)) \
  X(CALL, 0, clGetEventProfilingInfo, (void *object, STUB_ASK), (object, STUB_ASKED)) \
  X(RETAIN, STUB_EVENT, clRetainEvent, (void *object), (object)) \
  X(RELEASE, STUB_EVENT, clReleaseEvent, (void *object), (object))

#define STUB_RESULT_CALL       int
#define STUB_RESULT_OWN        int
#define STUB_RESULT_ENQUEUE    int
#define STUB_RESULT_RETAIN     int
#define STUB_RESULT_RELEASE    int
#define STUB_RESULT_CREATE     void *
#define STUB_RESULT_OWN_CREATE void *

#define STUB_X(role, kind, name, parameters, arguments) STUB_##name,
enum { STUB_LIST(STUB_X) STUB_CALLS };
#undef STUB_X
#define STUB_X(role, kind, name, parameters, arguments) #name,
static const char *const stub_names[STUB_CALLS] = { STUB_LIST(STUB_X) };
#undef STUB_X
#define STUB_X(role, kind, name, parameters, arguments) STUB_RESULT_##role (*name) parameters;
static struct { STUB_LIST(STUB_X) } real_cl;                 /* the real library's: not counted, never failing */
#undef STUB_X

typedef struct stub_state {
  int         loaded;                 /* 1 = the real library is there, -1 = it is not */
  unsigned    calls, by_name[STUB_CALLS], waits;   /* since the last reset: in all; by name; those that wait for the device */
  unsigned    fail_at;                /* the call that fails, from 1; 0 = none */
  int         fail_code, lost;        /* with what; and so do all after it */
  const char *failed;                 /* the first that did */
  long        live[STUB_KINDS];
  int         no_platforms, no_devices, fake_gpu, refuse_build;
  uint64_t    little_memory;          /* bytes of the device, and of a buffer; 0 = what there is */
  size_t      group;                  /* work-items of the largest group so far */
  int         pending;                /* something was enqueued and not waited for */
  unsigned    misused;
  char        misuse[128];
} stub_state;
static stub_state stub;
static const char stub_log[] = "line 1234: error: the stub does not like this kernel";

/* What OpenCL implementations and their compilers never give back, for the leak sanitizer. Some are unloaded again, and
 * then not known by name. Without that sanitizer nobody calls this, and there is nothing to switch off. */
const char *__lsan_default_suppressions(void);
const char *__lsan_default_suppressions(void) { return "leak:libLLVM\nleak:libpocl\nleak:libOpenCL\nleak:Rusticl\n"; }
static void stub_lsan(const char *name)
{
  void *address = dlsym(NULL, name);       /* in this program, that is */
  void (*function)(void) = NULL;
  memcpy(&function, &address, sizeof address);
  if (function) function();
}

static int stub_load(void)                         /* 1 = there is a real library to forward to */
{
  void *library;
  if (stub.loaded) return stub.loaded > 0;
  library = dlopen("libOpenCL.so.1", RTLD_NOW | RTLD_LOCAL);
  stub.loaded = library ? 1 : -1;
  if (library) {
    void *address;
    #define STUB_X(role, kind, name, parameters, arguments) \
      address = dlsym(library, #name); \
      memcpy(&real_cl.name, &address, sizeof address); \
      if (!address) stub.loaded = -1;
    STUB_LIST(STUB_X)
    #undef STUB_X
    stub_lsan("__lsan_disable");
    if (stub.loaded > 0) real_cl.clGetPlatformIDs(0, NULL, NULL);      /* loads all there are */
    stub_lsan("__lsan_enable");
  }
  return stub.loaded > 0;
}
static void stub_reset(unsigned fail_at, int code, int lost)
{
  stub.calls = stub.waits = 0;
  memset(stub.by_name, 0, sizeof stub.by_name);
  stub.fail_at = fail_at;
  stub.fail_code = code;
  stub.lost = lost;
  stub.failed = NULL;
}
static void stub_quiet(void) { stub_reset(0, 0, 0); }
static int stub_enter(int call)                    /* 0, or the error to return */
{
  if (!stub_load()) return CL_NO_PLATFORM;
  ++stub.by_name[call];
  ++stub.calls;
  if (!stub.fail_at || stub.calls < stub.fail_at || (stub.calls > stub.fail_at && !stub.lost)) return 0;
  if (!stub.failed) stub.failed = stub_names[call];
  return stub.fail_code;
}
static void stub_misuse(const char *call, const char *what)
{
  if (!stub.misused++) snprintf(stub.misuse, sizeof stub.misuse, "%s: %s", call, what);
}
static int stub_event(int error, int kind, void **event)
{
  if (!error && event) ++stub.live[kind];
  if (!error) stub.pending = 1;
  return error;
}
static int stub_answer(const void *value, size_t bytes, size_t size, void *out, size_t *needed)
{
  if (needed) *needed = bytes;
  if (out && size < bytes) return -30;
  if (out) memcpy(out, value, bytes);
  return 0;
}

#define STUB_BODY_CALL(kind, name, parameters, arguments) \
  int name parameters; \
  int name parameters { int e = stub_enter(STUB_##name); return e ? e : real_cl.name arguments; }
#define STUB_BODY_ENQUEUE(kind, name, parameters, arguments) \
  int name parameters; \
  int name parameters { int e = stub_enter(STUB_##name); return e ? e : stub_event(real_cl.name arguments, kind, event); }
#define STUB_BODY_RETAIN(kind, name, parameters, arguments) \
  int name parameters; \
  int name parameters { int e = stub_enter(STUB_##name); if (!e) e = real_cl.name arguments; if (!e) ++stub.live[kind]; return e; }
#define STUB_BODY_RELEASE(kind, name, parameters, arguments) \
  int name parameters; \
  int name parameters { \
    if (!stub_load()) return CL_NO_PLATFORM; \
    ++stub.by_name[STUB_##name]; \
    if (!object) stub_misuse(#name, "a NULL object"); \
    if (--stub.live[kind] < 0) stub_misuse(#name, "more released than made"); \
    return real_cl.name arguments; \
  }
#define STUB_BODY_CREATE(kind, name, parameters, arguments) \
  void *name parameters; \
  void *name parameters { \
    int e = stub_enter(STUB_##name); \
    void *object = e ? NULL : real_cl.name arguments; \
    if (e && error) *error = e; \
    if (object) ++stub.live[kind]; \
    return object; \
  }
#define STUB_BODY_OWN(kind, name, parameters, arguments) int name parameters;
#define STUB_BODY_OWN_CREATE(kind, name, parameters, arguments) void *name parameters;
#define STUB_X(role, kind, name, parameters, arguments) STUB_BODY_##role(kind, name, parameters, arguments)
STUB_LIST(STUB_X)
#undef STUB_X

int clGetPlatformIDs(unsigned size, void **out, unsigned *count)
{
  int e = stub_enter(STUB_clGetPlatformIDs);
  if (!e && stub.no_platforms) e = CL_NO_PLATFORM;
  if (e && count) *count = 0;
  return e ? e : real_cl.clGetPlatformIDs(size, out, count);
}
int clGetDeviceIDs(void *platform, uint64_t type, unsigned size, void **out, unsigned *count)
{
  int e = stub_enter(STUB_clGetDeviceIDs);
  if (!e && (stub.no_devices || (stub.fake_gpu && !(type & CL_TYPE_GPU)))) e = CL_NOT_FOUND;
  if (e && count) *count = 0;
  return e ? e : real_cl.clGetDeviceIDs(platform, stub.fake_gpu ? CL_TYPE_CPU | CL_TYPE_GPU : type, size, out, count);
}
int clGetDeviceInfo(void *device, unsigned what, size_t size, void *out, size_t *needed)
{
  static const uint64_t gpu = CL_TYPE_GPU;
  int e = stub_enter(STUB_clGetDeviceInfo);
  if (e) return e;
  if (what == CL_DEVICE_TYPE && stub.fake_gpu) return stub_answer(&gpu, sizeof gpu, size, out, needed);
  if ((what == CL_DEVICE_MAX_ALLOC || what == CL_DEVICE_MEMORY) && stub.little_memory)
    return stub_answer(&stub.little_memory, sizeof stub.little_memory, size, out, needed);
  return real_cl.clGetDeviceInfo(device, what, size, out, needed);
}
void *clCreateBuffer(void *context, uint64_t flags, size_t size, void *host, int *error)
{
  int e = stub_enter(STUB_clCreateBuffer);
  void *object;
  if (!e && stub.little_memory && size > stub.little_memory) e = CL_BAD_SIZE;
  object = e ? NULL : real_cl.clCreateBuffer(context, flags, size, host, error);
  if (e && error) *error = e;
  if (object) ++stub.live[STUB_BUFFER];
  return object;
}
int clBuildProgram(void *program, unsigned count, void *const *devices, const char *options,
    void (*notify)(void *, void *), void *user)
{
  int e = stub_enter(STUB_clBuildProgram);
  if (!e && stub.refuse_build) e = CL_BUILD_FAILED;
  return e ? e : real_cl.clBuildProgram(program, count, devices, options, notify, user);
}
int clGetProgramBuildInfo(void *program, void *device, unsigned what, size_t size, void *out, size_t *needed)
{
  int e = stub_enter(STUB_clGetProgramBuildInfo);
  if (e) return e;
  if (what == CL_BUILD_LOG && stub.refuse_build) return stub_answer(stub_log, sizeof stub_log, size, out, needed);
  return real_cl.clGetProgramBuildInfo(program, device, what, size, out, needed);
}
int clEnqueueNDRangeKernel(void *queue, void *kernel, unsigned dimensions, const size_t *offset, const size_t *global,
    const size_t *local, unsigned waits, void *const *wait, void **event)
{
  int e = stub_enter(STUB_clEnqueueNDRangeKernel);
  unsigned i;
  for (i = 0; i < dimensions; ++i) {
    if (!global[i]) stub_misuse(stub_names[STUB_clEnqueueNDRangeKernel], "nothing to do");
    else if (!local || !local[i]) stub_misuse(stub_names[STUB_clEnqueueNDRangeKernel], "no local size");
    else if (global[i] % local[i]) stub_misuse(stub_names[STUB_clEnqueueNDRangeKernel], "sizes do not divide");
    else if (local[i] > stub.group) stub.group = local[i];
  }
  if (e) return e;
  e = real_cl.clEnqueueNDRangeKernel(queue, kernel, dimensions, offset, global, local, waits, wait, event);
  return stub_event(e, STUB_EVENT, event);
}
int clEnqueueReadBuffer(void *queue, void *buffer, unsigned blocking, size_t offset, size_t size, void *out,
    unsigned waits, void *const *wait, void **event)
{
  int e = stub_enter(STUB_clEnqueueReadBuffer);
  stub.waits += blocking != 0;
  if (e) return e;
  e = stub_event(real_cl.clEnqueueReadBuffer(queue, buffer, blocking, offset, size, out, waits, wait, event), STUB_EVENT,
      event);
  if (blocking) stub.pending = 0;
  return e;
}
int clEnqueueWriteBuffer(void *queue, void *buffer, unsigned blocking, size_t offset, size_t size, const void *in,
    unsigned waits, void *const *wait, void **event)
{
  int e = stub_enter(STUB_clEnqueueWriteBuffer);
  stub.waits += blocking != 0;
  if (e) return e;
  e = stub_event(real_cl.clEnqueueWriteBuffer(queue, buffer, blocking, offset, size, in, waits, wait, event), STUB_EVENT,
      event);
  if (blocking) stub.pending = 0;
  return e;
}
void *clEnqueueMapBuffer(void *queue, void *buffer, unsigned blocking, uint64_t flags, size_t offset, size_t size,
    unsigned waits, void *const *wait, void **event, int *error)
{
  int e = stub_enter(STUB_clEnqueueMapBuffer);
  void *mapped = NULL;
  stub.waits += blocking != 0;
  if (!e) mapped = real_cl.clEnqueueMapBuffer(queue, buffer, blocking, flags, offset, size, waits, wait, event, error);
  else if (error) *error = e;
  if (mapped) stub_event(0, STUB_EVENT, event);
  if (mapped && blocking) stub.pending = 0;
  return mapped;
}
/* A device that is lost does not go on using the host's memory: these do their work even where they fail. */
int clEnqueueUnmapMemObject(void *queue, void *buffer, void *mapped, unsigned waits, void *const *wait, void **event)
{
  int e = stub_enter(STUB_clEnqueueUnmapMemObject), done;
  done = stub_load() ? real_cl.clEnqueueUnmapMemObject(queue, buffer, mapped, waits, wait, e ? NULL : event) : CL_NO_PLATFORM;
  return e ? e : stub_event(done, STUB_EVENT, event);
}
int clFinish(void *queue)
{
  int e = stub_enter(STUB_clFinish), done = stub_load() ? real_cl.clFinish(queue) : CL_NO_PLATFORM;
  ++stub.waits;
  stub.pending = 0;
  return e ? e : done;
}
int clWaitForEvents(unsigned count, void *const *events)
{
  int e = stub_enter(STUB_clWaitForEvents), done = stub_load() ? real_cl.clWaitForEvents(count, events) : CL_NO_PLATFORM;
  ++stub.waits;
  return e ? e : done;
}

static void check_nothing_alive(void)              /* what is reported is forgotten */
{
  int kind;
  for (kind = 0; kind < STUB_KINDS; ++kind) CHECK_MSG(!stub.live[kind], "%ld %s are left", stub.live[kind], stub_kinds[kind]);
  memset(stub.live, 0, sizeof stub.live);
}

// >>application -----------------------------------------------------------------------------------------------------
typedef struct own { void *platform, *id, *context, *queue; trbvh_device *device; } own;

static unsigned count_devices(void)             /* by asking the real library */
{
  void *platforms[16];
  unsigned count = 0, found = 0, i;
  if (!stub_load() || real_cl.clGetPlatformIDs(16, platforms, &count)) return 0;
  for (i = 0; i < count && i < 16; ++i) {
    unsigned here = 0;
    if (!real_cl.clGetDeviceIDs(platforms[i], 0xFFFFFFFFu, 0, NULL, &here)) found += here;
  }
  return found;
}
static int find_device(own *o)                     /* the first GPU, else the first CPU */
{
  static const uint64_t types[] = {CL_TYPE_GPU, CL_TYPE_CPU};
  void *platforms[16];
  unsigned count = 0, i, t;
  memset(o, 0, sizeof *o);
  if (!stub_load() || real_cl.clGetPlatformIDs(16, platforms, &count)) return 0;
  for (t = 0; t < 2; ++t)
    for (i = 0; i < count && i < 16; ++i) {
      o->platform = platforms[i];
      if (real_cl.clGetDeviceIDs(platforms[i], types[t], 1, &o->id, NULL) == 0) return 1;
    }
  return 0;
}
static void own_open(own *o)
{
  trbvh_cl_desc desc = {0};
  trbvh_stats stats;
  int error = 0;
  find_device(o);
  o->context = real_cl.clCreateContext(NULL, 1, &o->id, NULL, NULL, &error);
  o->queue = real_cl.clCreateCommandQueue(o->context, o->id, 0, &error);
  desc.queue = (struct _cl_command_queue *)o->queue;
  o->device = trbvh_cl_open(&desc, &stats);
  CHECK_MSG(o->device, "a queue of the application's: %s", stats.message);
}
static unsigned references(const own *o, int of_context)
{
  unsigned count = 0;
  if (of_context) real_cl.clGetContextInfo(o->context, CL_CONTEXT_REFERENCES, sizeof count, &count, NULL);
  else real_cl.clGetCommandQueueInfo(o->queue, CL_QUEUE_REFERENCES, sizeof count, &count, NULL);
  return count;
}
static void own_close(own *o)
{
  int tries;
  trbvh_cl_close(o->device);
  check_nothing_alive();
  for (tries = 0; tries < 1000 && references(o, 0) > 1; ++tries) {   /* threads of OpenCL's own may still be tidying up */
    const struct timespec millisecond = {0, 1000000};
    nanosleep(&millisecond, NULL);
  }
  CHECK_MSG(references(o, 0) == 1, "%u references to the application's queue", references(o, 0));
  real_cl.clReleaseCommandQueue(o->queue);
  real_cl.clReleaseContext(o->context);
}
static struct _cl_mem *own_buffer(const own *o, const void *bytes, size_t size)
{
  int error = 0;
  void *buffer = real_cl.clCreateBuffer(o->context, 1u | (bytes ? CL_COPY_HOST : 0u), size ? size : 4, (void *)(uintptr_t)bytes, &error);
  CHECK_MSG(buffer, "the test's own buffer: error %d", error);
  return (struct _cl_mem *)buffer;
}
static void *own_read(const own *o, struct _cl_mem *buffer, size_t size)
{
  void *bytes = xmalloc(size);
  CHECK(!size || real_cl.clEnqueueReadBuffer(o->queue, buffer, 1, 0, size, bytes, 0, NULL, NULL) == 0);
  return bytes;
}
static void own_release(struct _cl_mem *buffer) { if (buffer) real_cl.clReleaseMemObject(buffer); }

enum { FORM_TIGHT, FORM_OFFSETS, FORM_WIDE, FORM_SHORT, FORMS };
static trbvh_cl_geometry own_geometry(const own *o, const scene *s, int form)
{
  static const size_t strides[FORMS] = {0, 16, 40, 12}, offsets[FORMS] = {0, 4, 32, 1024}, index_offsets[FORMS] = {0, 8, 4, 2};
  const size_t stride = strides[form] ? strides[form] : 12;
  const uint32_t index_size = form == FORM_SHORT && s->vertex_count <= 65536 ? 2 : 4;
  const size_t index_offset = index_size == 2 ? 2 : index_offsets[form] & ~(size_t)3;
  const size_t vertices_size = stride * s->vertex_count + offsets[form];
  unsigned char *vertices = (unsigned char *)xmalloc(vertices_size + 12);
  uint32_t i;
  trbvh_cl_geometry g;
  memset(vertices, 0xFF, vertices_size);
  for (i = 0; i < s->vertex_count; ++i) memcpy(vertices + offsets[form] + stride * i, s->positions + 3 * i, 12);
  memset(&g, 0, sizeof g);
  g.positions = own_buffer(o, vertices, vertices_size);
  g.position_offset = offsets[form];
  g.position_stride = strides[form];
  g.position_count = s->indices || form != FORM_TIGHT ? s->vertex_count : 0;
  g.count = s->count;
  if (s->indices) {
    unsigned char *indices = (unsigned char *)xmalloc(index_offset + (size_t)index_size * 3 * s->count);
    memset(indices, 0xFF, index_offset);
    for (i = 0; i < 3 * s->count; ++i) {
      const uint16_t half = (uint16_t)s->indices[i];
      memcpy(indices + index_offset + index_size * i, index_size == 2 ? (const void *)&half : &s->indices[i], index_size);
    }
    g.indices = own_buffer(o, indices, index_offset + (size_t)index_size * 3 * s->count);
    g.index_offset = index_offset;
    g.index_size = form == FORM_TIGHT ? 0 : index_size;
    free(indices);
  }
  free(vertices);
  return g;
}
static void own_geometry_free(trbvh_cl_geometry *g) { own_release(g->positions); own_release(g->indices); }

// >>cache -----------------------------------------------------------------------------------------------------------
#define CACHE_ENTRIES 16u
typedef struct memory_cache {
  char     key[CACHE_ENTRIES][256];
  void    *bytes[CACHE_ENTRIES];
  size_t   size[CACHE_ENTRIES];
  unsigned count, loads, saves;
  int      odd;                                    /* load fills in something else than it told of: 1 nothing, 2 half, 3 more */
} memory_cache;

static size_t cache_load(void *user, const char *key, void *out, size_t capacity)
{
  memory_cache *c = (memory_cache *)user;
  unsigned i;
  ++c->loads;
  for (i = 0; i < c->count; ++i)
    if (!strcmp(c->key[i], key)) {
      size_t size = c->size[i];
      if (c->odd && capacity) size = c->odd == 1 ? 0 : c->odd == 2 ? size / 2 : capacity + 100;
      if (size <= capacity && size <= c->size[i] && out) memcpy(out, c->bytes[i], size);
      return size;
    }
  return 0;
}
static void cache_save(void *user, const char *key, const void *bytes, size_t size)
{
  memory_cache *c = (memory_cache *)user;
  const char *p;
  unsigned i;
  ++c->saves;
  for (p = key; *p; ++p)
    CHECK_MSG((*p >= 'a' && *p <= 'z') || (*p >= 'A' && *p <= 'Z') || (*p >= '0' && *p <= '9') || strchr("._-", *p), "key %s", key);
  CHECK_MSG(p != key && p - key < 200 && bytes && size, "key %s, %zu bytes", key, size);
  for (i = 0; i < c->count && strcmp(c->key[i], key); ++i) {}
  CHECK_MSG(i < CACHE_ENTRIES, "more than %u programs", CACHE_ENTRIES);
  if (i == CACHE_ENTRIES) return;
  if (i == c->count) ++c->count;
  else free(c->bytes[i]);
  snprintf(c->key[i], sizeof c->key[i], "%s", key);
  c->bytes[i] = xmalloc(size);
  memcpy(c->bytes[i], bytes, size);
  c->size[i] = size;
}
static void cache_free(memory_cache *c)
{
  unsigned i;
  for (i = 0; i < c->count; ++i) free(c->bytes[i]);
}

#endif
