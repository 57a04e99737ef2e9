// Macros for code compiled by both the host compiler and nvcc.
#pragma once

// PGCCD_HD: inlined. PGCCD_HD_LANES: by the host compiler too, where a loop over lanes or a vector's code depends on
// it, whatever else calls it. PGCCD_HD_RARE: not inlined, for large, rarely executed templates. PGCCD_TARGET: by nvcc
// for devices only, for templates that call device functions there.
#if defined(__CUDACC__)
#define PGCCD_HD __host__ __device__ __forceinline__
#define PGCCD_HD_LANES PGCCD_HD
#define PGCCD_HD_RARE __host__ __device__ __noinline__
#define PGCCD_TARGET __device__ __forceinline__
#else
#define PGCCD_HD inline
#define PGCCD_HD_LANES [[gnu::always_inline]] inline
#define PGCCD_HD_RARE [[gnu::noinline]]
#define PGCCD_TARGET inline
#endif

// Placed before a loop with a long body to prevent unrolling on devices, whose instruction caches are small.
#if defined(__CUDA_ARCH__)
#define PGCCD_KEEP_LOOP _Pragma("unroll 1")
#define PGCCD_UNROLL _Pragma("unroll")
#else
#define PGCCD_KEEP_LOOP
#define PGCCD_UNROLL
#endif
