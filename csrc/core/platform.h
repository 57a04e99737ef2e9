// Marks code that both the host compiler and nvcc translate, so that one source yields both backends.
#pragma once

#if defined(__CUDACC__)
#define PGCCD_HD __host__ __device__ __forceinline__
#else
#define PGCCD_HD inline
#endif
