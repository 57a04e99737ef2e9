// Macros for code compiled by both the host compiler and nvcc.
#pragma once

// PGCCD_HD: inlined; by the host compiler too, whatever else calls it, in source files that define PGCCD_INLINE_ALL
// because their vector code depends on it. PGCCD_HD_RARE: not inlined, for large, rarely executed templates.
// PGCCD_TARGET, PGCCD_TARGET_RARE: by nvcc for devices only, for templates that call device functions there.
#if defined(__CUDACC__)
#define PGCCD_HD __host__ __device__ __forceinline__
#define PGCCD_HD_RARE __host__ __device__ __noinline__
#define PGCCD_TARGET __device__ __forceinline__
#define PGCCD_TARGET_RARE __device__ __noinline__
#else
#if defined(PGCCD_INLINE_ALL)
#define PGCCD_HD [[gnu::always_inline]] inline
#else
#define PGCCD_HD inline
#endif
#define PGCCD_HD_RARE [[gnu::noinline]]
#define PGCCD_TARGET inline
#define PGCCD_TARGET_RARE inline
#endif

// Placed before a loop with a long body to prevent unrolling on devices, whose instruction caches are small.
#if defined(__CUDA_ARCH__)
#define PGCCD_KEEP_LOOP _Pragma("unroll 1")
#define PGCCD_UNROLL _Pragma("unroll")
#else
#define PGCCD_KEEP_LOOP
#define PGCCD_UNROLL
#endif
