/* 04_own_kernel.c - a kernel of your own draws a mesh that lies, and moves, in an OpenCL device's memory.
 * Introduces: your context and queue, building from buffers, events, trbvh_cl_source, refitting.
 *
 *   cc -O3 examples/04_own_kernel.c -o own_kernel -lm -ldl && ./own_kernel own_kernel.png
 */
#define TRBVH_IMPLEMENTATION
#include "../trbvh_cl.h"
#define EX_PROGRAM "04_own_kernel"
#include "common.h"

// >>opencl --------------------------------------------------------------------------------------------------
/* A real program has #include <CL/cl.h> instead of this section, and is linked with -lOpenCL. This one is to
 * compile and start everywhere, so it declares what it uses, and looks for the library when it runs. */
#ifdef _WIN32
  #include <windows.h>
  #define CL_API_CALL __stdcall
#else
  #include <dlfcn.h>
  #define CL_API_CALL
#endif
typedef int32_t cl_int;
typedef uint32_t cl_uint;
typedef uint64_t cl_ulong;
typedef struct _cl_platform_id *cl_platform_id;
typedef struct _cl_device_id *cl_device_id;
typedef struct _cl_context *cl_context;
typedef struct _cl_command_queue *cl_command_queue;
typedef struct _cl_mem *cl_mem;
typedef struct _cl_program *cl_program;
typedef struct _cl_kernel *cl_kernel;
typedef struct _cl_event *cl_event;
enum { CL_MEM_READ_WRITE = 1, CL_MEM_COPY_HOST_PTR = 32, CL_PROGRAM_BUILD_LOG = 0x1183 };
static const cl_ulong CL_DEVICE_TYPE_GPU = 4, CL_DEVICE_TYPE_ALL = 0xFFFFFFFF;

#define CL_FUNCTIONS(X) \
  X(cl_int, clGetPlatformIDs, (cl_uint, cl_platform_id *, cl_uint *)) \
  X(cl_int, clGetDeviceIDs, (cl_platform_id, cl_ulong, cl_uint, cl_device_id *, cl_uint *)) \
  X(cl_context, clCreateContext, (const intptr_t *, cl_uint, const cl_device_id *, \
    void (CL_API_CALL *)(const char *, const void *, size_t, void *), void *, cl_int *)) \
  X(cl_command_queue, clCreateCommandQueue, (cl_context, cl_device_id, cl_ulong, cl_int *)) \
  X(cl_mem, clCreateBuffer, (cl_context, cl_ulong, size_t, void *, cl_int *)) \
  X(cl_program, clCreateProgramWithSource, (cl_context, cl_uint, const char **, const size_t *, cl_int *)) \
  X(cl_int, clBuildProgram, (cl_program, cl_uint, const cl_device_id *, const char *, \
    void (CL_API_CALL *)(cl_program, void *), void *)) \
  X(cl_int, clGetProgramBuildInfo, (cl_program, cl_device_id, cl_uint, size_t, void *, size_t *)) \
  X(cl_kernel, clCreateKernel, (cl_program, const char *, cl_int *)) \
  X(cl_int, clSetKernelArg, (cl_kernel, cl_uint, size_t, const void *)) \
  X(cl_int, clEnqueueNDRangeKernel, (cl_command_queue, cl_kernel, cl_uint, const size_t *, const size_t *, \
    const size_t *, cl_uint, const cl_event *, cl_event *)) \
  X(cl_int, clEnqueueReadBuffer, (cl_command_queue, cl_mem, cl_uint, size_t, size_t, void *, cl_uint, \
    const cl_event *, cl_event *)) \
  X(cl_int, clWaitForEvents, (cl_uint, const cl_event *)) \
  X(cl_int, clReleaseEvent, (cl_event)) \
  X(cl_int, clReleaseKernel, (cl_kernel)) \
  X(cl_int, clReleaseProgram, (cl_program)) \
  X(cl_int, clReleaseMemObject, (cl_mem)) \
  X(cl_int, clReleaseCommandQueue, (cl_command_queue)) \
  X(cl_int, clReleaseContext, (cl_context)) \
  X(cl_int, clFinish, (cl_command_queue))
#define CL_DECLARE(type, name, arguments) static type (CL_API_CALL *name) arguments;
CL_FUNCTIONS(CL_DECLARE)

static void (*find_function(const char *name))(void)
{
  void (*function)(void) = NULL;
#ifdef _WIN32
  HMODULE library = LoadLibraryA("OpenCL.dll");
  if (library) function = (void (*)(void))GetProcAddress(library, name);
#else
  void *library = dlopen("libOpenCL.so.1", RTLD_NOW | RTLD_LOCAL);
  if (!library) library = dlopen("libOpenCL.so", RTLD_NOW | RTLD_LOCAL);
  if (!library) library = dlopen("/System/Library/Frameworks/OpenCL.framework/OpenCL", RTLD_NOW | RTLD_LOCAL);
  void *symbol = library ? dlsym(library, name) : NULL;
  memcpy(&function, &symbol, sizeof function);   /* ISO C has no cast for that */
#endif
  return function;
}
static int load_opencl(void)
{
  int complete = 1;
  void (*function)(void);
#define CL_LOAD(type, name, arguments) \
  function = find_function(#name); \
  memcpy(&name, &function, sizeof function); \
  complete &= function != NULL;
  CL_FUNCTIONS(CL_LOAD)
  return complete;
}

// >>kernels -------------------------------------------------------------------------------------------------
/* They come behind trbvh_cl_source(), which brings trbvh_node, trbvh_triangle, trbvh_ray, trbvh_hit,
 * trbvh_intersect and trbvh_occluded. */
static const char kernel_tools[] =
  "typedef struct scene {\n"
  "  const __global trbvh_node *nodes;\n"
  "  const __global trbvh_triangle *triangles;\n"
  "  const __global float *positions;\n"
  "  const __global uint *indices;\n"
  "  uint knot_triangles;                 // the others are the water's\n"
  "} scene;\n"
  "trbvh_ray make_ray(float3 origin, float3 dir, float tmax) {          // tmax 0: no limit\n"
  "  trbvh_ray ray = {{origin.x, origin.y, origin.z}, 0, {dir.x, dir.y, dir.z}, tmax};\n"
  "  return ray;\n"
  "}\n"
  "float random(uint *state) {\n"
  "  *state = *state * 747796405u + 2891336453u;\n"
  "  uint x = ((*state >> ((*state >> 28) + 4)) ^ *state) * 277803737u;\n"
  "  return ((x >> 22 ^ x) >> 8) / 16777216.0f;\n"
  "}\n"
  "float3 sky(float3 dir) {\n"
  "  float3 horizon = (float3)(0.80f, 0.52f, 0.36f), zenith = (float3)(0.02f, 0.08f, 0.28f);\n"
  "  return mix(horizon, zenith, sqrt(clamp(dir.y, 0.0f, 1.0f)));\n"
  "}\n"
  "// A direction around n, more often near it (Duff et al., JCGT 2017, for the frame).\n"
  "float3 cosine_direction(float3 n, float a, float b) {\n"
  "  float sign = n.z < 0 ? -1.0f : 1.0f, p = -1 / (sign + n.z), q = n.x * n.y * p;\n"
  "  float3 s = (float3)(1 + sign * n.x * n.x * p, sign * q, -sign * n.x);\n"
  "  float3 t = (float3)(q, sign + n.y * n.y * p, -n.y);\n"
  "  return sqrt(a) * (cos(6.2831853f * b) * s + sin(6.2831853f * b) * t) + sqrt(1 - a) * n;\n"
  "}\n";

static const char kernel_draw[] =
  "// The light that comes along a ray, and along its reflection; a and b choose the ambient ray.\n"
  "float3 light_along(scene s, float3 origin, float3 dir, float a, float b) {\n"
  "  const float3 sun = normalize((float3)(-0.60f, 0.62f, 0.40f));\n"
  "  float3 light = 0, share = 1;\n"
  "  for (int bounce = 0; bounce < 3; bounce++) {\n"
  "    trbvh_hit hit;\n"
  "    if (!trbvh_intersect(s.nodes, s.triangles, make_ray(origin, dir, 0), &hit)) break;\n"
  "    const __global uint *corner = s.indices + 3 * hit.prim;\n"
  "    float3 v0 = vload3(corner[0], s.positions);\n"
  "    float3 e1 = vload3(corner[1], s.positions) - v0, e2 = vload3(corner[2], s.positions) - v0;\n"
  "    float3 normal = normalize(cross(e1, e2));\n"
  "    if (dot(normal, dir) > 0) normal = -normal;\n"
  "    float3 point = v0 + hit.u * e1 + hit.v * e2 + 1e-4f * normal;   // off the surface\n"
  "    int knot = hit.prim < s.knot_triangles;\n"
  "    float3 color = knot ? (float3)(0.74f, 0.36f, 0.09f) : (float3)(0.01f, 0.06f, 0.08f);\n"
  "    float fresnel = pow(1 + dot(dir, normal), 5.0f);\n"
  "    float3 mirror = knot ? 0.3f * color + 0.5f * fresnel : (float3)(0.15f + 0.8f * fresnel);\n"
  "\n"
  "    float3 received = 0;\n"
  "    float facing = dot(normal, sun);\n"
  "    if (facing > 0 && !trbvh_occluded(s.nodes, s.triangles, make_ray(point, sun, 0)))\n"
  "      received += facing * (float3)(1.8f, 1.25f, 0.75f);\n"
  "    float3 around = cosine_direction(normal, a, b);\n"
  "    trbvh_intersect(s.nodes, s.triangles, make_ray(point, around, 4), &hit);\n"
  "    received += hit.t / 4 * (float3)(0.26f, 0.32f, 0.46f);          // on a miss t is 4\n"
  "    float clear = knot ? 1 : 1 - smoothstep(20.0f, 30.0f, length(point.xz));\n"
  "    light += share * mix(sky(dir), color * received * (1 - mirror), clear);\n"
  "    share *= mirror * clear;\n"
  "    origin = point;\n"
  "    dir -= 2 * dot(dir, normal) * normal;\n"
  "    if (share.x + share.y + share.z < 0.03f) return light;\n"
  "  }\n"
  "  return light + share * sky(dir);\n"
  "}\n"
  "// A work-item is a pixel, of 4 x 4 samples.\n"
  "__kernel void draw(const __global trbvh_node *nodes, const __global trbvh_triangle *triangles,\n"
  "                   const __global float *positions, const __global uint *indices, uint knot_triangles,\n"
  "                   float4 eye, float4 forward, float4 right, float4 up, __global uchar *rgb) {\n"
  "  scene s = {nodes, triangles, positions, indices, knot_triangles};\n"
  "  uint x = get_global_id(0), y = get_global_id(1), pixel = y * get_global_size(0) + x, seed = pixel;\n"
  "  float3 sum = 0;\n"
  "  float a = random(&seed), b = random(&seed), ignored;\n"
  "  for (uint i = 0; i < 16; i++) {\n"
  "    float sx = (x + (i % 4 + 0.5f) / 4) / get_global_size(0) * 2 - 1;\n"
  "    float sy = 1 - (y + (i / 4 + 0.5f) / 4) / get_global_size(1) * 2;\n"
  "    float3 dir = normalize(forward.xyz + sx * right.xyz + sy * up.xyz);\n"
  "    sum += light_along(s, eye.xyz, dir, a, b);\n"
  "    a = fract(a + 1.0f / 16, &ignored);\n"
  "    b = fract(b + 0.618034f, &ignored);\n"
  "  }\n"
  "  sum = sum / 16;\n"
  "  sum = sum * (2.51f * sum + 0.03f) / (sum * (2.43f * sum + 0.59f) + 0.14f);   // a film's response\n"
  "  vstore3(convert_uchar3(255 * pow(clamp(sum, 0.0f, 1.0f), 1 / 2.2f) + 0.5f), pixel, rgb);\n"
  "}\n";

static const char kernel_wave[] =
  "// Makes rings in the water, and twists the knot. A work-item is a vertex.\n"
  "__kernel void wave(const __global float *rest, __global float *positions, uint knot_vertices) {\n"
  "  uint i = get_global_id(0);\n"
  "  float3 p = vload3(i, rest);\n"
  "  if (i < knot_vertices) {\n"
  "    float angle = 0.25f * (p.y - 4.6f), c = cos(angle), s = sin(angle);\n"
  "    p = (float3)(c * p.x + s * p.z, p.y, c * p.z - s * p.x);\n"
  "  } else {\n"
  "    float r = length(p.xz);\n"
  "    p.y += 0.10f * exp(-0.1f * r) * cos(4 * r);\n"
  "  }\n"
  "  vstore3(p, i, positions);\n"
  "}\n";

// >>host ----------------------------------------------------------------------------------------------------
static void check_cl(cl_int error, const char *what)
{
  if (error) ex_die("%s: OpenCL error %d", what, (int)error);
}
/* The first GPU, or else the first device at all; NULL = there is none. */
static cl_device_id choose_device(void)
{
  enum { MOST = 16 };
  cl_platform_id platforms[MOST];
  cl_uint count = 0;
  if (clGetPlatformIDs(MOST, platforms, &count)) return NULL;
  if (count > MOST) count = MOST;
  for (cl_uint i = 0; i < 2 * count; i++) {   /* all platforms for a GPU, and once more for anything */
    cl_device_id device;
    cl_ulong type = i < count ? CL_DEVICE_TYPE_GPU : CL_DEVICE_TYPE_ALL;
    if (!clGetDeviceIDs(platforms[i % count], type, 1, &device, NULL)) return device;
  }
  return NULL;
}
/* size bytes, with what is at data in it if that is not NULL */
static cl_mem make_buffer(cl_context context, size_t size, const void *data)
{
  cl_int error;
  cl_ulong flags = CL_MEM_READ_WRITE | (data ? CL_MEM_COPY_HOST_PTR : 0);
  cl_mem buffer = clCreateBuffer(context, flags, size, (void *)(uintptr_t)data, &error);
  check_cl(error, "clCreateBuffer");
  return buffer;
}
static cl_program make_program(cl_context context, cl_device_id device)
{
  const char *const own[] = {kernel_tools, kernel_draw, kernel_wave};
  cl_uint count, own_count = sizeof own / sizeof *own;
  const char *const *library = trbvh_cl_source(&count);
  const char **lines = (const char **)ex_allocate(count + own_count, sizeof *lines);
  cl_int error;
  memcpy(lines, library, count * sizeof *lines);
  memcpy(lines + count, own, sizeof own);
  cl_program program = clCreateProgramWithSource(context, count + own_count, lines, NULL, &error);
  check_cl(error, "clCreateProgramWithSource");
  if (clBuildProgram(program, 1, &device, NULL, NULL, NULL)) {
    static char log[65536];
    clGetProgramBuildInfo(program, device, CL_PROGRAM_BUILD_LOG, sizeof log - 1, log, NULL);
    ex_die("the kernels do not compile:\n%s", log);
  }
  free(lines);
  return program;
}
typedef struct argument { const void *value; size_t size; } argument;
#define ARGUMENT(x) {&(x), sizeof(x)}
static void run_kernel(cl_command_queue queue, cl_kernel kernel, const argument *arguments, cl_uint count,
                       size_t width, size_t height)
{
  size_t size[2] = {width, height};
  for (cl_uint i = 0; i < count; i++) {
    check_cl(clSetKernelArg(kernel, i, arguments[i].size, arguments[i].value), "clSetKernelArg");
  }
  cl_int error = clEnqueueNDRangeKernel(queue, kernel, 2, NULL, size, NULL, 0, NULL, NULL);
  check_cl(error, "clEnqueueNDRangeKernel");
}
static double wait_for(cl_event event, double start)   /* returns the time since start */
{
  check_cl(clWaitForEvents(1, &event), "clWaitForEvents");
  clReleaseEvent(event);
  return ex_now_ms() - start;
}
static ex_vec water_point(const void *unused, float u, float v)   /* a disc, finer towards its middle */
{
  float angle = 2 * EX_PI * u, radius = 30 * v * (0.4f + 0.6f * v);
  (void)unused;
  return ex_v(radius * cosf(angle), 0, radius * sinf(angle));
}

int main(int argc, char **argv)
{
  enum { WIDTH = 480, HEIGHT = 360, GAP = 8, WHOLE = 2 * WIDTH + GAP };
  const char *path = argc > 1 ? argv[1] : "own_kernel.png";

  /* 1. A context and a queue, as any OpenCL program has them. */
  cl_device_id device = load_opencl() ? choose_device() : NULL;
  if (!device) {
    printf("no OpenCL device here: nothing to show\n");
    return 0;
  }
  cl_int error;
  cl_context context = clCreateContext(NULL, 1, &device, NULL, NULL, &error);
  check_cl(error, "clCreateContext");
  cl_command_queue queue = clCreateCommandQueue(context, device, 0, &error);
  check_cl(error, "clCreateCommandQueue");

  /* 2. The library works on that queue. */
  trbvh_cl_desc desc = {.queue = queue};
  trbvh_stats stats;
  trbvh_device *builder = trbvh_cl_open(&desc, &stats);
  if (!builder) {
    printf("no use for this OpenCL device: %s\n", stats.message);
    clReleaseCommandQueue(queue);
    clReleaseContext(context);
    return 0;
  }
  printf("device: %s\n", trbvh_cl_name(builder));

  /* 3. A mesh: a knot over water. Its vertices at rest, those that move, and its triangles, on the device. */
  ex_builder b;
  ex_vec center = ex_v(0, 4.6f, 0);
  memset(&b, 0, sizeof b);
  ex_add_surface(&b, ex_knot_point, &center, 96, 800, 1);
  cl_uint knot_vertices = b.mesh.position_count, knot_triangles = b.mesh.triangle_count;
  ex_add_surface(&b, water_point, NULL, 720, 480, 1);
  if (b.failed) ex_die("not enough memory");
  cl_uint vertices = b.mesh.position_count;
  cl_mem rest = make_buffer(context, vertices * 3 * sizeof(float), b.mesh.positions);
  cl_mem positions = make_buffer(context, vertices * 3 * sizeof(float), b.mesh.positions);
  cl_mem indices = make_buffer(context, b.mesh.triangle_count * 3 * sizeof(cl_uint), b.mesh.indices);
  cl_mem pixels = make_buffer(context, 3 * WIDTH * HEIGHT, NULL);
  trbvh_cl_geometry geometry = {
    .positions = positions, .position_count = vertices, .indices = indices, .count = b.mesh.triangle_count
  };
  ex_mesh_free(&b.mesh);               /* the device has it all */

  /* 4. A tree from these buffers, in buffers. The first build compiles the library's kernels. */
  trbvh_cl_tree tree = {0};
  trbvh_options options = {.stats = &stats};
  for (int run = 0; run < 2; run++) {
    cl_event built;
    double start = ex_now_ms();
    ex_check(trbvh_cl_build(builder, &tree, &geometry, &options, &built), "trbvh_cl_build", &stats);
    double ms = wait_for(built, start);
    printf("%s: %.1f ms, %u triangles, %u nodes\n", run ? "built again" : "built, with compiling", ms,
           geometry.count, tree.node_count);
  }

  /* 5. Kernels of your own, behind the library's source. Calls go through the same queue: no need to wait. */
  double start = ex_now_ms();
  cl_program program = make_program(context, device);
  cl_kernel draw = clCreateKernel(program, "draw", &error);
  check_cl(error, "clCreateKernel");
  cl_kernel wave = clCreateKernel(program, "wave", &error);
  check_cl(error, "clCreateKernel");
  printf("own kernels compiled: %.1f ms\n", ex_now_ms() - start);

  ex_camera c = ex_camera_look_at(ex_v(-5.5f, 3.0f, 13.5f), ex_v(0.2f, 2.5f, 0), ex_v(0, 1, 0), 50,
                                  (float)WIDTH / HEIGHT);
  float eye[4] = {c.eye.x, c.eye.y, c.eye.z, 0}, forward[4] = {c.forward.x, c.forward.y, c.forward.z, 0};
  float right[4] = {c.right.x, c.right.y, c.right.z, 0}, up[4] = {c.up.x, c.up.y, c.up.z, 0};
  const argument wave_arguments[] = {ARGUMENT(rest), ARGUMENT(positions), ARGUMENT(knot_vertices)};
  const argument draw_arguments[] = {
    ARGUMENT(tree.nodes), ARGUMENT(tree.triangles), ARGUMENT(positions), ARGUMENT(indices),
    ARGUMENT(knot_triangles), ARGUMENT(eye), ARGUMENT(forward), ARGUMENT(right), ARGUMENT(up),
    ARGUMENT(pixels)
  };
  uint8_t *panel = (uint8_t *)ex_allocate(WIDTH * HEIGHT, 3);
  uint8_t *picture = (uint8_t *)ex_allocate(WHOLE * HEIGHT, 3);
  memset(picture, 255, (size_t)3 * WHOLE * HEIGHT);
  for (int frame = 0; frame < 2; frame++) {
    /* 6. For the second frame, the vertices move, and the tree's boxes follow: sooner done than building, and
     * as good as long as neighbours stay neighbours. */
    if (frame == 1) {
      cl_event refitted;
      run_kernel(queue, wave, wave_arguments, 3, vertices, 1);
      check_cl(clFinish(queue), "clFinish");   /* only to measure what comes */
      for (int run = 0; run < 2; run++) {
        start = ex_now_ms();
        ex_check(trbvh_cl_refit(builder, &tree, &geometry, &refitted), "trbvh_cl_refit", NULL);
        double ms = wait_for(refitted, start);
        printf("%s: %.1f ms\n", run ? "refitted again" : "refitted, with compiling", ms);
      }
    }
    start = ex_now_ms();
    run_kernel(queue, draw, draw_arguments, 10, WIDTH, HEIGHT);
    check_cl(clEnqueueReadBuffer(queue, pixels, 1, 0, 3 * WIDTH * HEIGHT, panel, 0, NULL, NULL),
             "clEnqueueReadBuffer");   /* waits */
    printf("drawn: %.1f ms\n", ex_now_ms() - start);
    for (size_t y = 0; y < HEIGHT; y++) {
      size_t left = (size_t)frame * (WIDTH + GAP);
      memcpy(picture + 3 * (y * WHOLE + left), panel + 3 * y * WIDTH, 3 * WIDTH);
    }
  }
  if (!ex_png_write(path, picture, WHOLE, HEIGHT)) ex_die("%s: cannot be written", path);
  printf("wrote %s\n", path);

  free(panel);
  free(picture);
  trbvh_cl_free(builder, &tree);
  trbvh_cl_close(builder);
  const cl_mem buffers[] = {rest, positions, indices, pixels};
  for (int i = 0; i < 4; i++) clReleaseMemObject(buffers[i]);
  clReleaseKernel(draw);
  clReleaseKernel(wave);
  clReleaseProgram(program);
  clReleaseCommandQueue(queue);
  clReleaseContext(context);
  return 0;
}
