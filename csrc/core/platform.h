// Marks code that both the host compiler and nvcc translate, so that one source yields both backends.
#pragma once

#if defined(__CUDACC__)
#define PGCCD_HD __host__ __device__ __forceinline__
// For templates that are rare and large: kept out of the code that calls them.
#define PGCCD_HD_RARE __host__ __device__ __noinline__
#else
#define PGCCD_HD inline
#define PGCCD_HD_RARE [[gnu::noinline]]
#endif
