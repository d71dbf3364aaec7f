// What all kernels share. Compiled at run time by NVRTC; the constants in capitals come from render/protocol.py.
//
// A kernel is a function of one struct of arguments. The structs are declared beside their kernels, and Python reads the
// declarations (launching.py), so nothing is said twice. Tests run the same text on the CPU, where `KERNEL` and the
// built-in functions of CUDA are defined by tests/emulation.

#ifndef KERNEL
#define KERNEL(name, Arguments) extern "C" __global__ void __launch_bounds__(THREADS) name(const Arguments a)
#endif

#define THREADS 256
#define WARPS (THREADS / 32)
#define EVERYONE 0xffffffffu
#define TILE 16

// Floats of a record: u, v (pixels), the quadratic form A dx^2 + B dx dy + C dy^2 = -log2 of the footprint, opacity,
// z (m), slope_u, slope_v (m / pixel).
#define RECORD 12

// Sums of a splat over the pixels of a tile, in this order, then one for each feature. With e = alpha dL/dalpha,
// w = T alpha, the offset (dx, dy) from the centre, and the loss's derivatives g by depth and plane depth:
//   e, e dx, e dy, e dx dx, e dx dy, e dy dy, w g_depth, w g_plane, w g_plane dx, w g_plane dy
#define MOMENTS 10

__device__ inline float clamp(float x, float low, float high) { return fminf(fmaxf(x, low), high); }

// Of 2 WIDTH values keeps half, with what the lane 2 WIDTH away has of them added; that one keeps the other half.
template <int WIDTH> __device__ inline void exchange_halves(float (&v)[16]) {
    const bool upper = threadIdx.x & (2 * WIDTH);
#pragma unroll
    for (int k = 0; k < WIDTH; k++) {
        const float kept = upper ? v[k + WIDTH] : v[k], given = upper ? v[k] : v[k + WIDTH];
        v[k] = kept + __shfl_xor_sync(EVERYONE, given, 2 * WIDTH);
    }
}

// Sums sixteen values over a warp: lane l gets the sum of value l / 2. By sixteen shuffles; one after the other, the
// values would take eighty.
__device__ inline float warp_sums(float (&v)[16]) {
    exchange_halves<8>(v);
    exchange_halves<4>(v);
    exchange_halves<2>(v);
    exchange_halves<1>(v);
    return v[0] + __shfl_xor_sync(EVERYONE, v[0], 1);
}
