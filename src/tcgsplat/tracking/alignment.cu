// Direct alignment on a GPU, as alignment.py and alignment_kernels.py have it: pyramids, reference points, Gauss-Newton
// passes. The pose and the photometry stay here from pass to pass, so that none of them is waited for.
//
// Depth images mark pixels that saw nothing of the world by -1, pixels without a reading by 0.

// Rows of the reference points [POINT, n], channels of a live image, entries of the sums and of the state.
enum { PX, PY, PZ, NX, NY, NZ, REFERENCE, WEIGHT, POINT };
enum { INTENSITY, SLOPE_X, SLOPE_Y, DEPTH, CHANNELS };
enum {
    HESSIAN = 0, GRADIENT = 21, COLOR_SQUARES = 27, COLOR_WEIGHT, DEPTH_SQUARES, DEPTH_WEIGHT, GAIN_W, GAIN_R, GAIN_L,
    GAIN_RR, GAIN_RL, GAIN_LL, IN_VIEW, READINGS, AGREEING, SUMS, PADDED = 48
};
enum { POSE = 0, GAIN = 16, OFFSET, COLOR_SCALE, DEPTH_SCALE, DONE, PASSES, STATE };

__device__ inline float luma(float red, float green, float blue) { return 0.299f * red + 0.587f * green + 0.114f * blue; }

struct RenderedView {
    const float* color;         // [3, height, width], times alpha
    const float* plane_depth;   // times alpha
    const float* alpha;
    float* intensity;           // divided by alpha
    float* depth;               // marked where hardly anything covers
    float* composited;          // intensity as it was drawn
    float* solid;               // depth, marked where the map is not all but opaque
    int pixels;
    float min_alpha;
};

KERNEL(rendered_view, RenderedView) {
    const int i = blockIdx.x * THREADS + threadIdx.x;
    if (i >= a.pixels) return;
    const float drawn = luma(a.color[i], a.color[i + a.pixels], a.color[i + 2 * a.pixels]), alpha = a.alpha[i];
    const float inverse = 1.0f / fmaxf(alpha, THIN), depth = alpha > a.min_alpha ? a.plane_depth[i] * inverse : -1.0f;
    a.intensity[i] = drawn * inverse, a.depth[i] = depth;
    a.composited[i] = drawn, a.solid[i] = alpha > SOLID ? depth : -1.0f;
}

struct LiveView {
    const float* color;         // [height, width, 3]
    const float* measured;
    const unsigned char* valid;
    float* intensity;
    float* depth;
    int pixels;
};

KERNEL(live_view, LiveView) {
    const int i = blockIdx.x * THREADS + threadIdx.x;
    if (i >= a.pixels) return;
    a.intensity[i] = luma(a.color[3 * i], a.color[3 * i + 1], a.color[3 * i + 2]);
    a.depth[i] = a.valid[i] ? a.measured[i] : -1.0f;
}

struct Halve {
    const float* image;         // twice as wide, and as high
    float* half;
    int width, height, pitch;   // of the half; of a row of the whole
};

KERNEL(halve_intensity, Halve) {
    const int i = blockIdx.x * THREADS + threadIdx.x;
    if (i >= a.width * a.height) return;
    const float* from = a.image + 2 * (i / a.width) * a.pitch + 2 * (i % a.width);
    a.half[i] = 0.25f * (from[0] + from[1] + from[a.pitch] + from[a.pitch + 1]);
}

// The mean of the readings that agree with the nearest one; -1 if any saw nothing.
KERNEL(halve_depth, Halve) {
    const int i = blockIdx.x * THREADS + threadIdx.x;
    if (i >= a.width * a.height) return;
    const float* from = a.image + 2 * (i / a.width) * a.pitch + 2 * (i % a.width);
    const float d[4] = {from[0], from[1], from[a.pitch], from[a.pitch + 1]};
    float nearest = 1e9f, lowest = 0.0f, total = 0.0f, count = 0.0f;
    for (float reading : d) {
        lowest = fminf(lowest, reading);
        if (reading > 0.0f) nearest = fminf(nearest, reading);
    }
    for (float reading : d)
        if (reading > 0.0f && reading < nearest * (1.0f + SMOOTH)) total += reading, count += 1.0f;
    a.half[i] = lowest < 0.0f ? -1.0f : count > 0.0f ? total / count : 0.0f;
}

struct LiveImage {
    const float* intensity;
    const float* depth;
    float* image;               // [height, width, CHANNELS]; nobody asks for its border
    int width, height;
};

KERNEL(live_image, LiveImage) {
    const int i = blockIdx.x * THREADS + threadIdx.x, x = i % a.width, y = i / a.width;
    if (x < 1 || y < 1 || x >= a.width - 1 || y >= a.height - 1) return;
    float* out = a.image + (long long)CHANNELS * i;
    out[INTENSITY] = a.intensity[i], out[DEPTH] = a.depth[i];
    out[SLOPE_X] = 0.5f * (a.intensity[i + 1] - a.intensity[i - 1]);
    out[SLOPE_Y] = 0.5f * (a.intensity[i + a.width] - a.intensity[i - a.width]);
}

struct ReferencePoints {
    const float* intensity;
    const float* depth;
    const float* weight;
    float* points;              // [POINT, n], n = columns * rows
    int width, columns, n, radius, stride;
    float fx, fy, cx, cy;
};

// Points of a rendered view in its camera frame; normals from depth differences, where both axes are straight.
KERNEL(reference_points, ReferencePoints) {
    const int i = blockIdx.x * THREADS + threadIdx.x;
    if (i >= a.n) return;
    const int x = 2 + a.stride * (i % a.columns), y = 2 + a.stride * (i / a.columns), at = y * a.width + x;
    const float per_pixel = 0.5f / a.radius, jump = 0.04f * a.radius, bend = 0.015f * a.radius;
    const float d = a.depth[at] >= TINY ? a.depth[at] : 0.0f;
    const float left = a.depth[at - a.radius], right = a.depth[at + a.radius];
    const float up = a.depth[at - a.radius * a.width], down = a.depth[at + a.radius * a.width];
    const float p = (x - a.cx) / a.fx, q = (y - a.cy) / a.fy;
    const float dz_du = (right - left) * per_pixel, dz_dv = (down - up) * per_pixel;
    // Tangents of the back-projected surface along u and v; their product points at the camera.
    const float ux = d / a.fx + p * dz_du, uy = q * dz_du, uz = dz_du;
    const float vx = p * dz_dv, vy = d / a.fy + q * dz_dv, vz = dz_dv;
    const float nx = uz * vy - uy * vz, ny = ux * vz - uz * vx, nz = uy * vx - ux * vy;
    // A neighbour without a reading, 0 or less, is a jump.
    const float jumps = fmaxf(fmaxf(fabsf(left - d), fabsf(right - d)), fmaxf(fabsf(up - d), fabsf(down - d)));
    const float bends = fmaxf(fabsf(left + right - 2.0f * d), fabsf(up + down - 2.0f * d));
    const bool straight = jumps < d * jump && bends < d * bend;
    const float inverse = straight ? 1.0f / sqrtf(nx * nx + ny * ny + nz * nz) : 0.0f;
    const float point[POINT] = {
        p * d, q * d, d, nx * inverse, ny * inverse, nz * inverse, a.intensity[at], a.weight[at]
    };
#pragma unroll
    for (int k = 0; k < POINT; k++) a.points[k * a.n + i] = point[k];
}

struct NormalEquations {
    const float* points;
    const float* live;          // [height, width, CHANNELS]
    const double* state;        // [STATE]
    float* partial;             // [blocks, PADDED]
    int n, width, height;
    float fx, fy, cx, cy, gate, balance, sigma_floor, sigma_slope;
};

// One weighted residual into the normal equations.
__device__ inline void add_residual(float* sums, float weight, float r, const float (&j)[6]) {
    int entry = HESSIAN;
#pragma unroll
    for (int row = 0; row < 6; row++) {
        const float wj = weight * j[row];
        sums[GRADIENT + row] += wj * r;
#pragma unroll
        for (int column = row; column < 6; column++) sums[entry++] += wj * j[column];
    }
}

// The sums of a point; see `alignment_kernels.normal_equations`.
__device__ inline void add_point(float (&sums)[PADDED], const NormalEquations& a, int i) {
    const double* T = a.state + POSE;
    const float px = a.points[PX * a.n + i], py = a.points[PY * a.n + i], pz = a.points[PZ * a.n + i];
    const float r00 = T[0], r01 = T[1], r02 = T[2], r10 = T[4], r11 = T[5], r12 = T[6], r20 = T[8], r21 = T[9], r22 = T[10];
    const float X = px * r00 + py * r01 + pz * r02 + (float)T[3];
    const float Y = px * r10 + py * r11 + pz * r12 + (float)T[7];
    const float Z = px * r20 + py * r21 + pz * r22 + (float)T[11];
    if (pz < TINY || !(Z >= NEAREST)) return;
    const float iz = 1.0f / Z, u = X * iz * a.fx + a.cx, v = Y * iz * a.fy + a.cy;
    if (!(u >= 1.0f && u < a.width - 2 && v >= 1.0f && v < a.height - 2)) return;
    const int x0 = (int)u, y0 = (int)v;
    const float* square = a.live + (long long)CHANNELS * (y0 * a.width + x0);
    const float* below = square + CHANNELS * a.width;
    const float s = u - x0, t = v - y0, w11 = s * t, w10 = s - w11, w01 = t - w11, w00 = 1.0f - s - w01;
    float mixed[CHANNELS];
#pragma unroll
    for (int k = 0; k < CHANNELS; k++)
        mixed[k] = w00 * square[k] + w10 * square[CHANNELS + k] + w01 * below[k] + w11 * below[CHANNELS + k];

    // Depth: bilinear where the four pixels lie on one surface, else the nearest one's.
    const float d00 = square[DEPTH], d10 = square[CHANNELS + DEPTH], d01 = below[DEPTH], d11 = below[CHANNELS + DEPTH];
    const float low = fminf(fminf(d00, d10), fminf(d01, d11)), high = fmaxf(fmaxf(d00, d10), fmaxf(d01, d11));
    const float nearest = t >= 0.5f ? (s >= 0.5f ? d11 : d01) : (s >= 0.5f ? d10 : d00);
    const float d = high - low >= low * SMOOTH ? nearest : mixed[DEPTH];
    if (!(d >= 0.0f)) return;
    const bool reading = d >= TINY, agreeing = reading && (0.5f * d + 1.0f) * a.gate >= fabsf(d - Z);
    const float behind = agreeing ? d - Z : 0.0f, weight = a.points[WEIGHT * a.n + i];

    // Geometry. dr/drho = -n, dr/domega = -(Y x n); residual and slope are divided by n . ray.
    const float n0 = a.points[NX * a.n + i], n1 = a.points[NY * a.n + i], n2 = a.points[NZ * a.n + i];
    const float nx = n0 * r00 + n1 * r01 + n2 * r02, ny = n0 * r10 + n1 * r11 + n2 * r12, nz = n0 * r20 + n1 * r21 + n2 * r22;
    const float facing = (nx * X + ny * Y + nz * Z) * iz;
    const bool faces = fabsf(facing) >= FACING;
    const float scale = faces ? 1.0f / facing : 0.0f;
    const float past = d - BASE, sigma = past * past * a.sigma_slope + a.sigma_floor, precision = 1.0f / (sigma * sigma);
    const float color_scale = a.state[COLOR_SCALE], depth_scale = a.state[DEPTH_SCALE];
    const float color_precision = 1.0f / (color_scale * color_scale), depth_precision = 1.0f / (depth_scale * depth_scale);
    const float depth_square = behind * behind * precision, depth_counts = agreeing && faces ? weight : 0.0f;
    const float depth_weight = depth_counts * (STUDENT_DOF + 1.0f) / (depth_square * depth_precision + STUDENT_DOF);
    {
        const float jx = -nx * scale, jy = -ny * scale, jz = -nz * scale;
        const float j[6] = {jx, jy, jz, Y * jz - Z * jy, Z * jx - X * jz, X * jy - Y * jx};
        add_residual(sums, depth_weight * precision * (depth_precision * a.balance), behind, j);
    }

    // Colour, where the depth does not disagree.
    const float reference = a.points[REFERENCE * a.n + i], seen = mixed[INTENSITY];
    const float r = seen - (reference * (float)a.state[GAIN] + (float)a.state[OFFSET]);
    const float color_counts = reading && !agreeing ? 0.0f : weight;
    const float color_weight = color_counts * (STUDENT_DOF + 1.0f) / (r * r * color_precision + STUDENT_DOF);
    {
        const float jx = mixed[SLOPE_X] * iz * a.fx, jy = mixed[SLOPE_Y] * iz * a.fy, jz = -(jx * X + jy * Y) * iz;
        const float j[6] = {jx, jy, jz, Y * jz - Z * jy, Z * jx - X * jz, X * jy - Y * jx};
        add_residual(sums, color_weight * color_precision, r, j);
    }
    sums[COLOR_SQUARES] += color_weight * r * r, sums[COLOR_WEIGHT] += color_counts;
    sums[DEPTH_SQUARES] += depth_weight * depth_square, sums[DEPTH_WEIGHT] += depth_counts;
    sums[GAIN_W] += color_weight, sums[GAIN_R] += color_weight * reference, sums[GAIN_L] += color_weight * seen;
    sums[GAIN_RR] += color_weight * reference * reference, sums[GAIN_RL] += color_weight * reference * seen;
    sums[GAIN_LL] += color_weight * seen * seen;
    sums[IN_VIEW] += 1.0f, sums[READINGS] += reading, sums[AGREEING] += agreeing;
}

KERNEL(normal_equations, NormalEquations) {
    __shared__ float of_warps[WARPS][PADDED];
    if (a.state[DONE] != 0.0) return;
    const int i = blockIdx.x * THREADS + threadIdx.x, lane = threadIdx.x & 31, warp = threadIdx.x / 32;
    float sums[PADDED] = {};
    if (i < a.n) add_point(sums, a, i);
#pragma unroll
    for (int k = 0; k < PADDED / 16; k++) {
        float part[16];
#pragma unroll
        for (int v = 0; v < 16; v++) part[v] = sums[16 * k + v];
        const float sum = warp_sums(part);
        if (!(lane & 1)) of_warps[warp][16 * k + lane / 2] = sum;
    }
    __syncthreads();
    if (threadIdx.x < PADDED) {
        float total = 0.0f;
        for (int k = 0; k < WARPS; k++) total += of_warps[k][threadIdx.x];
        a.partial[PADDED * blockIdx.x + threadIdx.x] = total;
    }
}

struct Advance {
    const float* partial;
    double* sums;               // [SUMS]
    double* state;
    int blocks;
    int moves;                  // whether the pose and the photometry follow; else there are only the sums
    int finest;                 // a level that is not ends where its steps get small
};

// Exposure from weighted moments, spreads from rms; see `alignment.Photometry`.
__device__ inline void refit(const double* sums, double* state) {
    if (sums[COLOR_WEIGHT] > 0) state[COLOR_SCALE] = fmax(0.008, sqrt(sums[COLOR_SQUARES] / sums[COLOR_WEIGHT]));
    if (sums[DEPTH_WEIGHT] > 0) state[DEPTH_SCALE] = fmax(0.05, sqrt(sums[DEPTH_SQUARES] / sums[DEPTH_WEIGHT]));
    const double total = sums[GAIN_W];
    if (total > ENOUGH_FOR_EXPOSURE) {
        const double reference = sums[GAIN_R] / total, live = sums[GAIN_L] / total;
        const double variance = sums[GAIN_RR] / total - reference * reference;
        const double covariance = sums[GAIN_RL] / total - reference * live;
        const double gain = (covariance + FLAT_VARIANCE) / (variance + FLAT_VARIANCE);
        state[GAIN] = fmin(MAX_GAIN, fmax(1 / MAX_GAIN, gain));
        state[OFFSET] = live - state[GAIN] * reference;
    }
}

// The damped Gauss-Newton step, by Cholesky's decomposition.
__device__ inline void solve(const double* sums, double (&step)[6]) {
    double L[6][6], y[6];
    int entry = HESSIAN;
    for (int row = 0; row < 6; row++)
        for (int column = row; column < 6; column++)
            L[column][row] = sums[entry++] + (row == column ? 1 / (STEP_PRIOR * STEP_PRIOR) : 0);
    for (int k = 0; k < 6; k++) {
        for (int j = 0; j < k; j++) L[k][k] -= L[k][j] * L[k][j];
        L[k][k] = sqrt(L[k][k]);
        for (int i = k + 1; i < 6; i++) {
            for (int j = 0; j < k; j++) L[i][k] -= L[i][j] * L[k][j];
            L[i][k] /= L[k][k];
        }
    }
    for (int k = 0; k < 6; k++) {
        y[k] = -sums[GRADIENT + k];
        for (int j = 0; j < k; j++) y[k] -= L[k][j] * y[j];
        y[k] /= L[k][k];
    }
    for (int k = 5; k >= 0; k--) {
        step[k] = y[k];
        for (int j = k + 1; j < 6; j++) step[k] -= L[j][k] * step[j];
        step[k] /= L[k][k];
    }
}

// T = exp(step) T.
__device__ inline void move(double* T, const double (&step)[6]) {
    const double angle = sqrt(step[3] * step[3] + step[4] * step[4] + step[5] * step[5]), length = fmax(angle, 1e-300);
    const double x = step[3] / length, y = step[4] / length, z = step[5] / length, half = sin(0.5 * angle);
    const double K[3][3] = {{0, -z, y}, {z, 0, -x}, {-y, x, 0}}, sine = sin(angle), versine = 2 * half * half;
    double E[3][4], moved[12];
    for (int i = 0; i < 3; i++) {
        E[i][3] = step[i];
        for (int j = 0; j < 3; j++) {
            double KK = 0;
            for (int k = 0; k < 3; k++) KK += K[i][k] * K[k][j];
            E[i][j] = (i == j) + sine * K[i][j] + versine * KK;
            E[i][3] += (versine / length * K[i][j] + (1 - sine / length) * KK) * step[j];
        }
    }
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 4; j++) {
            moved[4 * i + j] = j == 3 ? E[i][3] : 0;
            for (int k = 0; k < 3; k++) moved[4 * i + j] += E[i][k] * T[4 * k + j];
        }
    for (int k = 0; k < 12; k++) T[k] = moved[k];
}

// By one block: the partial sums in their order, and where they lead.
KERNEL(advance, Advance) {
    if (a.state[DONE] != 0.0) return;
    if (threadIdx.x < SUMS) {
        double total = 0;
        for (int block = 0; block < a.blocks; block++) total += a.partial[PADDED * block + threadIdx.x];
        a.sums[threadIdx.x] = total;
    }
    __syncthreads();
    if (threadIdx.x != 0 || !a.moves) return;
    double step[6];
    refit(a.sums, a.state);
    solve(a.sums, step);
    move(a.state + POSE, step);
    a.state[PASSES] += 1;
    const double shift = step[0] * step[0] + step[1] * step[1] + step[2] * step[2];
    const double turn = step[3] * step[3] + step[4] * step[4] + step[5] * step[5];
    if (!a.finest && shift < SMALL * SMALL && turn < SMALL * SMALL) a.state[DONE] = 1;
}
