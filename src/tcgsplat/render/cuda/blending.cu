// Front-to-back compositing (Eq. 1 and render/protocol.py), one tile a block, one pixel a thread, and back.
//
// FEATURES is fixed when the text is compiled. Images are planes: the features, then depth, plane depth and alpha.

#define PLANES (FEATURES + 3)
#define BATCH 32

struct Blend {
    const float* records;
    const float* features;      // [n, FEATURES]
    const long long* pairs;     // [pairs] pairs of all tiles, one after the other, each tile's by depth
    const int* owners;
    const long long* starts;    // [tiles + 1]
    float* planes;              // [PLANES, height, width]
    float* through;             // [height, width] what the last one lets through
    int* used;                  // [height, width] pairs of the tile that were looked at
    int width, height, tiles_x;
};

// A warp covers eight by four pixels, which mostly lie in the same splats.
#define WARP_WIDTH 8
#define WARP_HEIGHT 4

__device__ inline int left_of(int warp, int tile, int tiles_x) { return TILE * (tile % tiles_x) + WARP_WIDTH * (warp & 1); }
__device__ inline int top_of(int warp, int tile, int tiles_x) { return TILE * (tile / tiles_x) + WARP_HEIGHT * (warp >> 1); }

// What all threads of a block read of a splat.
struct Shared {
    float record[9];
    float features[FEATURES];
    unsigned warps;             // a bit for each that the splat reaches: most splats are smaller than a tile
};

__device__ inline void load(
    Shared& splat, const float* records, const float* features, long long owner, int tile, int tiles_x
) {
#pragma unroll
    for (int k = 0; k < 9; k++) splat.record[k] = records[RECORD * owner + k];
#pragma unroll
    for (int f = 0; f < FEATURES; f++) splat.features[f] = features[FEATURES * owner + f];
    const float limit = limit_of(splat.record);
    splat.warps = 0;
#pragma unroll
    for (int warp = 0; warp < WARPS; warp++) {
        const int left = left_of(warp, tile, tiles_x), top = top_of(warp, tile, tiles_x);
        splat.warps |= (least_within(splat.record, left, top, WARP_WIDTH, WARP_HEIGHT) <= limit) << warp;
    }
}

// Both ways ask this: what they leave out as too faint is the same.
__device__ inline float alpha_at(const float* r, float dx, float dy) {
    return r[5] * exp2f(-((r[2] * dx + r[3] * dy) * dx + r[4] * dy * dy));
}

__device__ inline float plane_at(const float* r, float dx, float dy) { return r[6] + r[7] * dx + r[8] * dy; }

KERNEL(blend, Blend) {
    __shared__ Shared splats[THREADS];
    const int tile = blockIdx.x, warp = threadIdx.x / 32, lane = threadIdx.x & 31;
    const int x = left_of(warp, tile, a.tiles_x) + lane % WARP_WIDTH, y = top_of(warp, tile, a.tiles_x) + lane / WARP_WIDTH;
    const bool inside = x < a.width && y < a.height;
    const long long first = a.starts[tile], end = a.starts[tile + 1];
    float out[PLANES] = {}, through = 1.0f;
    int used = 0;
    bool done = !inside;
    for (long long start = first; start < end; start += THREADS) {
        if (__syncthreads_count(done) == THREADS) break;  // also: nobody reads the last batch any more
        const int count = (int)(end - start < THREADS ? end - start : THREADS);
        if ((int)threadIdx.x < count) {
            const long long owner = a.owners[a.pairs[start + threadIdx.x]];
            load(splats[threadIdx.x], a.records, a.features, owner, tile, a.tiles_x);
        }
        __syncthreads();
        for (int k = 0; k < count && !done; k++) {
            const Shared& splat = splats[k];
            if (!(splat.warps >> warp & 1)) continue;
            const float* r = splat.record;
            const float dx = x - r[0], dy = y - r[1];
            const float alpha = alpha_at(r, dx, dy);
            if (alpha < MIN_ALPHA) continue;
            const float weight = through * alpha;
#pragma unroll
            for (int f = 0; f < FEATURES; f++) out[f] += weight * splat.features[f];
            out[FEATURES] += weight * r[6];
            out[FEATURES + 1] += weight * plane_at(r, dx, dy);
            out[FEATURES + 2] += weight;
            through *= 1.0f - alpha;
            used = (int)(start - first) + k + 1;
            done = through < MIN_TRANSMITTANCE;
        }
    }
    if (!inside) return;
    const long long pixel = (long long)y * a.width + x, plane = (long long)a.width * a.height;
#pragma unroll
    for (int p = 0; p < PLANES; p++) a.planes[p * plane + pixel] = out[p];
    a.through[pixel] = through;
    a.used[pixel] = used;
}

struct BlendBackward {
    const float* records;
    const float* features;
    const long long* pairs;
    const int* owners;
    const long long* starts;
    const float* through;
    const int* used;
    const float* d_planes;      // [PLANES, height, width]
    float* sums;                // [pairs, SUMS], zero before
    int width, height, tiles_x;
};

// Back to front. What lies behind a splat counts by one number, the sum of weight times what the loss asks for there.
// Each pair's sums are written by the one block that has them, so that no order of adding is left to chance.
KERNEL(blend_backward, BlendBackward) {
    __shared__ Shared splats[BATCH];
    __shared__ float of_warps[WARPS][BATCH][SUMS];
    __shared__ int most_used;
    const int tile = blockIdx.x, lane = threadIdx.x & 31, warp = threadIdx.x / 32;
    const int x = left_of(warp, tile, a.tiles_x) + lane % WARP_WIDTH, y = top_of(warp, tile, a.tiles_x) + lane / WARP_WIDTH;
    const bool inside = x < a.width && y < a.height;
    const long long first = a.starts[tile], pixel = (long long)y * a.width + x, plane = (long long)a.width * a.height;
    const int used = inside ? a.used[pixel] : 0;
    float g[PLANES], through = inside ? a.through[pixel] : 1.0f, behind = 0.0f;
#pragma unroll
    for (int p = 0; p < PLANES; p++) g[p] = inside ? a.d_planes[p * plane + pixel] : 0.0f;
    if (threadIdx.x == 0) most_used = 0;
    __syncthreads();
    if (used) atomicMax(&most_used, used);
    __syncthreads();
    for (int stop = most_used; stop > 0; stop -= BATCH) {
        const int start = stop > BATCH ? stop - BATCH : 0, count = stop - start;
        if ((int)threadIdx.x < count) {
            const long long owner = a.owners[a.pairs[first + start + threadIdx.x]];
            load(splats[threadIdx.x], a.records, a.features, owner, tile, a.tiles_x);
        }
        __syncthreads();
        for (int k = count - 1; k >= 0; k--) {
            const Shared& splat = splats[k];
            const float* r = splat.record;
            const float dx = x - r[0], dy = y - r[1];
            const float alpha = alpha_at(r, dx, dy);
            const bool seen = start + k < used && alpha >= MIN_ALPHA;
            float* sums = of_warps[warp][k];
            if (!(splat.warps >> warp & 1) || !__any_sync(EVERYONE, seen)) {
                for (int v = lane; v < SUMS; v += 32) sums[v] = 0.0f;
                continue;
            }
            float value[SUMS / 16][16] = {};
            if (seen) {
                through /= 1.0f - alpha;
                const float weight = through * alpha, by_depth = g[FEATURES], by_plane = g[FEATURES + 1];
                float asked = by_depth * r[6] + by_plane * plane_at(r, dx, dy) + g[FEATURES + 2];
#pragma unroll
                for (int f = 0; f < FEATURES; f++) {
                    asked += g[f] * splat.features[f];
                    value[(MOMENTS + f) / 16][(MOMENTS + f) % 16] = weight * g[f];
                }
                const float e = alpha * (through * asked - behind / (1.0f - alpha));
                behind += weight * asked;
                const float moment[MOMENTS] = {
                    e, e * dx, e * dy, e * dx * dx, e * dx * dy, e * dy * dy,
                    weight * by_depth, weight * by_plane, weight * by_plane * dx, weight * by_plane * dy,
                };
#pragma unroll
                for (int v = 0; v < MOMENTS; v++) value[0][v] = moment[v];
            }
#pragma unroll
            for (int v = 0; v < SUMS / 16; v++) {
                const float sum = warp_sums(value[v]);
                if (!(lane & 1)) sums[16 * v + lane / 2] = sum;
            }
        }
        __syncthreads();
        for (int v = threadIdx.x; v < count * SUMS; v += THREADS) {
            float total = 0.0f;
            for (int k = 0; k < WARPS; k++) total += of_warps[k][v / SUMS][v % SUMS];
            a.sums[a.pairs[first + start + v / SUMS] * SUMS + v % SUMS] = total;
        }
        __syncthreads();
    }
}
