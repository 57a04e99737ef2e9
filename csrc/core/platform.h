// Marks code that both the host compiler and nvcc translate, so that one source yields both backends.
#pragma once

// PGCCD_HD: inlined. PGCCD_HD_RARE: for templates that are rare and large, kept out of the code that calls them.
#if defined(__CUDACC__)
#define PGCCD_HD __host__ __device__ __forceinline__
#define PGCCD_HD_RARE __host__ __device__ __noinline__
#else
#define PGCCD_HD inline
#define PGCCD_HD_RARE [[gnu::noinline]]
#endif

// Before a loop with a long body, not to be unrolled on devices: their instruction caches are small.
#if defined(__CUDA_ARCH__)
#define PGCCD_KEEP_LOOP _Pragma("unroll 1")
#define PGCCD_UNROLL _Pragma("unroll")
#else
#define PGCCD_KEEP_LOOP
#define PGCCD_UNROLL
#endif
