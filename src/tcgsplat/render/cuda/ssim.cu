// Structural similarity and its derivative, as render/ssim_kernels.py has them: 16 x 16 pixels of one channel a block.
//
// The window is separable: rows first, into shared memory, then columns. RADIUS comes from Python.

#define SPAN (TILE + 2 * RADIUS)
#define WINDOW (2 * RADIUS + 1)

struct Place {
    int channel, left, top;
};

__device__ inline Place place_of_block(int width, int height) {
    const int across = (width + TILE - 1) / TILE, down = (height + TILE - 1) / TILE, tile = blockIdx.x % (across * down);
    return {(int)blockIdx.x / (across * down), TILE * (tile % across), TILE * (tile / across)};
}

// The averages about each of the block's pixels of MAPS maps, whose values `value(map, pixel)` gives; zero beyond the
// image. The thread's own pixel is (threadIdx % TILE, threadIdx / TILE).
template <int MAPS, class Value>
__device__ inline void averages(
    const Place& at, int width, int height, const float* window, float (*rows)[SPAN][TILE], float (&average)[MAPS],
    const Value& value
) {
    for (int k = threadIdx.x; k < SPAN * TILE; k += THREADS) {
        const int x = at.left + k % TILE, y = at.top + k / TILE - RADIUS;
        float total[MAPS] = {};
        if (y >= 0 && y < height)
            for (int j = 0; j < WINDOW; j++) {
                const int from = x + j - RADIUS;
                if (from < 0 || from >= width) continue;
                float v[MAPS];
                value(((long long)at.channel * height + y) * width + from, v);
#pragma unroll
                for (int m = 0; m < MAPS; m++) total[m] += window[j] * v[m];
            }
#pragma unroll
        for (int m = 0; m < MAPS; m++) rows[m][k / TILE][k % TILE] = total[m];
    }
    __syncthreads();
    const int x = threadIdx.x % TILE, y = threadIdx.x / TILE;
#pragma unroll
    for (int m = 0; m < MAPS; m++) {
        average[m] = 0.0f;
        for (int j = 0; j < WINDOW; j++) average[m] += window[j] * rows[m][y + j][x];
    }
}

struct Ssim {
    const float* a;             // [channels, height, width]
    const float* b;
    const float* window;        // [WINDOW]
    float* similarity;
    float* by_mean;             // its derivatives by the averages of a, a a and a b
    float* by_aa;
    float* by_ab;
    int width, height;
};

KERNEL(ssim, Ssim) {
    __shared__ float rows[5][SPAN][TILE];
    const Place at = place_of_block(a.width, a.height);
    float average[5];
    averages(at, a.width, a.height, a.window, rows, average, [&](long long pixel, float (&v)[5]) {
        const float p = a.a[pixel], q = a.b[pixel];
        v[0] = p, v[1] = q, v[2] = p * p, v[3] = q * q, v[4] = p * q;
    });
    const int x = at.left + threadIdx.x % TILE, y = at.top + threadIdx.x / TILE;
    if (x >= a.width || y >= a.height) return;
    const float ma = average[0], mb = average[1];
    const float luminance = 2 * ma * mb + SSIM_C1, structure = 2 * (average[4] - ma * mb) + SSIM_C2;
    const float luminance_inverse = 1.0f / (ma * ma + mb * mb + SSIM_C1);
    const float structure_inverse = 1.0f / (average[2] - ma * ma + average[3] - mb * mb + SSIM_C2);
    const float both = luminance_inverse * structure_inverse, s = luminance * structure * both;
    const long long pixel = ((long long)at.channel * a.height + y) * a.width + x;
    a.similarity[pixel] = s;
    a.by_mean[pixel] = 2 * (mb * (structure - luminance) * both - ma * s * (luminance_inverse - structure_inverse));
    a.by_aa[pixel] = -s * structure_inverse;
    a.by_ab[pixel] = 2 * luminance * both;
}

struct SsimBackward {
    const float* upstream;      // [channels, height, width]
    const float* a;
    const float* b;
    const float* by_mean;
    const float* by_aa;
    const float* by_ab;
    const float* window;
    float* d_a;
    int width, height;
};

KERNEL(ssim_backward, SsimBackward) {
    __shared__ float rows[3][SPAN][TILE];
    const Place at = place_of_block(a.width, a.height);
    float average[3];
    averages(at, a.width, a.height, a.window, rows, average, [&](long long pixel, float (&v)[3]) {
        const float g = a.upstream[pixel];
        v[0] = g * a.by_mean[pixel], v[1] = g * a.by_aa[pixel], v[2] = g * a.by_ab[pixel];
    });
    const int x = at.left + threadIdx.x % TILE, y = at.top + threadIdx.x / TILE;
    if (x >= a.width || y >= a.height) return;
    const long long pixel = ((long long)at.channel * a.height + y) * a.width + x;
    a.d_a[pixel] = average[0] + 2 * a.a[pixel] * average[1] + a.b[pixel] * average[2];
}
