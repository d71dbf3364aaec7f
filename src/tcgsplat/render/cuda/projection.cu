// Eqs. 2 and 3 for one Gaussian a thread: parameters to what blending reads, and the chain rule back.
//
// The names follow render/reference.py and render/numba_cpu/projection.py: row r of J is the derivative of (u, v, z) by
// the map frame, N = J R(q), M = N S with the scales S, and the covariance of (u, v, z) is M M^T.

struct Camera {
    float fx, fy, cx, cy;
    int width, height;
};

struct Matrix {
    float m[3][3];
    __device__ float* operator[](int row) { return m[row]; }
    __device__ const float* operator[](int row) const { return m[row]; }
};

__device__ inline Matrix product(const Matrix& a, const Matrix& b) {
    Matrix c;
#pragma unroll
    for (int i = 0; i < 3; i++)
#pragma unroll
        for (int j = 0; j < 3; j++) c[i][j] = a[i][0] * b[0][j] + a[i][1] * b[1][j] + a[i][2] * b[2][j];
    return c;
}

__device__ inline Matrix transposed(const Matrix& a) {
    Matrix c;
#pragma unroll
    for (int i = 0; i < 3; i++)
#pragma unroll
        for (int j = 0; j < 3; j++) c[i][j] = a[j][i];
    return c;
}

// A Gaussian in a camera.
struct View {
    Matrix R, J, Q, N, M;
    float x, y, z, iz;      // centre; z is kept away from 0
    float depth;            // true z
    float a, b, ac, bc;     // x / z and y / z, and both inside the widened image
    float ju, jv;           // fx / z, fy / z
    float q[4], q_inverse;  // unit quaternion w, p, q, r, and 1 / length of the one given
    float scale[3];
    float uu, uv, uz, vv, vz;           // covariance
    float slope_u, slope_v;             // of the plane
    float plane_inverse;                // 1 / determinant of the softened covariance
    float inverse;                      // 1 / determinant of the blurred one
};

__device__ inline View look(
    const float* mean, const float* quat, const float* scale, const float* pose, const Camera& camera
) {
    View g;
#pragma unroll
    for (int i = 0; i < 3; i++)
#pragma unroll
        for (int j = 0; j < 3; j++) g.R[i][j] = pose[4 * i + j];
    const Matrix& R = g.R;
    g.x = R[0][0] * mean[0] + R[0][1] * mean[1] + R[0][2] * mean[2] + pose[3];
    g.y = R[1][0] * mean[0] + R[1][1] * mean[1] + R[1][2] * mean[2] + pose[7];
    g.depth = R[2][0] * mean[0] + R[2][1] * mean[1] + R[2][2] * mean[2] + pose[11];
    g.z = fmaxf(g.depth, 0.5f * NEAR_PLANE);
    g.iz = 1.0f / g.z;
    g.a = g.x * g.iz, g.b = g.y * g.iz;
    const float margin_x = JACOBIAN_MARGIN * 0.5f * camera.width / camera.fx;
    const float margin_y = JACOBIAN_MARGIN * 0.5f * camera.height / camera.fy;
    g.ac = clamp(
        g.a, (-0.5f - camera.cx) / camera.fx - margin_x, (camera.width - 0.5f - camera.cx) / camera.fx + margin_x
    );
    g.bc = clamp(
        g.b, (-0.5f - camera.cy) / camera.fy - margin_y, (camera.height - 0.5f - camera.cy) / camera.fy + margin_y
    );
    g.ju = camera.fx * g.iz, g.jv = camera.fy * g.iz;
#pragma unroll
    for (int j = 0; j < 3; j++) {
        g.J[0][j] = g.ju * (R[0][j] - g.ac * R[2][j]);
        g.J[1][j] = g.jv * (R[1][j] - g.bc * R[2][j]);
        g.J[2][j] = R[2][j];
    }

    const float length2 = quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3];
    g.q_inverse = 1.0f / sqrtf(fmaxf(length2, 1e-24f));
#pragma unroll
    for (int k = 0; k < 4; k++) g.q[k] = quat[k] * g.q_inverse;
    const float w = g.q[0], p = g.q[1], q = g.q[2], r = g.q[3];
    g.Q = {{
        {1 - 2 * (q * q + r * r), 2 * (p * q - w * r), 2 * (p * r + w * q)},
        {2 * (p * q + w * r), 1 - 2 * (p * p + r * r), 2 * (q * r - w * p)},
        {2 * (p * r - w * q), 2 * (q * r + w * p), 1 - 2 * (p * p + q * q)},
    }};
    g.N = product(g.J, g.Q);
#pragma unroll
    for (int k = 0; k < 3; k++) {
        g.scale[k] = scale[k];
#pragma unroll
        for (int i = 0; i < 3; i++) g.M[i][k] = g.N[i][k] * scale[k];
    }

    const Matrix covariance = product(g.M, transposed(g.M));
    g.uu = covariance[0][0], g.uv = covariance[0][1], g.uz = covariance[0][2];
    g.vv = covariance[1][1], g.vz = covariance[1][2];
    const float au = g.uu + PLANE_SOFTENING, av = g.vv + PLANE_SOFTENING;
    g.plane_inverse = 1.0f / (au * av - g.uv * g.uv);
    g.slope_u = (av * g.uz - g.uv * g.vz) * g.plane_inverse;
    g.slope_v = (au * g.vz - g.uv * g.uz) * g.plane_inverse;
    g.inverse = 1.0f / ((g.uu + BLUR) * (g.vv + BLUR) - g.uv * g.uv);
    return g;
}

struct Project {
    const float* means;
    const float* quats;
    const float* scales;
    const float* opacities;
    const float* pose;          // T_cam_map, row by row
    float* records;             // [n, RECORD]
    float* depths;              // [n], infinite where nothing is to be seen
    int* rectangles;            // [n, 4]: tiles left, top, right, bottom, the last ones included
    int* counts;                // [n] tiles that the footprint reaches
    unsigned char* visible;     // [n]
    int n;
    Camera camera;
};

// Least value of a splat's quadratic form over the pixel centres of a rectangle, and over the points between them.
__device__ inline float least_within(const float* record, int first_x, int first_y, int width, int height) {
    const float A = record[2], B = record[3], C = record[4];
    const float left = first_x - record[0], right = left + width - 1;
    const float top = first_y - record[1], bottom = top + height - 1;
    const float x = clamp(0.0f, left, right), y = clamp(0.0f, top, bottom);
    if (x == 0.0f && y == 0.0f) return 0.0f;
    // The form is convex and least at the centre, so it is least on a side that faces it.
    float least = 3.4e38f;
    if (x != 0.0f) {
        const float best = clamp(-0.5f * B * x / C, top, bottom);
        least = (A * x + B * best) * x + C * best * best;
    }
    if (y != 0.0f) {
        const float best = clamp(-0.5f * B * y / A, left, right);
        least = fminf(least, (A * best + B * y) * best + C * y * y);
    }
    return least;
}

// Below which the form is where alpha >= MIN_ALPHA: rounding may let in one pixel too many, never one too few.
__device__ inline float limit_of(const float* record) { return log2f(record[5] / MIN_ALPHA) * 1.0001f + 1e-4f; }

__device__ inline bool reaches(const float* record, int tile_x, int tile_y) {
    return least_within(record, TILE * tile_x, TILE * tile_y, TILE, TILE) <= limit_of(record);
}

KERNEL(project, Project) {
    const int i = blockIdx.x * THREADS + threadIdx.x;
    if (i >= a.n) return;
    const Camera& camera = a.camera;
    const View g = look(a.means + 3 * i, a.quats + 4 * i, a.scales + 3 * i, a.pose, camera);
    const float bu = g.uu + BLUR, bv = g.vv + BLUR;
    const float u = camera.fx * g.a + camera.cx, v = camera.fy * g.b + camera.cy;

    // The box around alpha >= MIN_ALPHA, rounded inwards to pixel centres of the image.
    const float opacity = a.opacities[i], k = 2.0f * logf(opacity / MIN_ALPHA);
    const float half_u = sqrtf(fmaxf(k, 0.0f) * bu), half_v = sqrtf(fmaxf(k, 0.0f) * bv);
    const float x0 = fmaxf(ceilf(u - half_u), 0.0f), x1 = fminf(floorf(u + half_u), camera.width - 1.0f);
    const float y0 = fmaxf(ceilf(v - half_v), 0.0f), y1 = fminf(floorf(v + half_v), camera.height - 1.0f);
    // Of needles thousands of pixels long rounding leaves no determinant, which is never below BLUR^2.
    const bool sound = g.inverse > 0.0f && g.inverse <= 1.001f / (BLUR * BLUR);
    const bool visible = k >= 0.0f && x0 <= x1 && y0 <= y1 && g.depth > NEAR_PLANE && sound;
    a.visible[i] = visible;
    a.depths[i] = visible ? g.depth : 3.4e38f;
    if (!visible) {
        a.counts[i] = 0;
        return;
    }
    const float scaled = 0.5f * LOG2_E * g.inverse;
    float record[RECORD] = {
        u, v, bv * scaled, -2.0f * g.uv * scaled, bu * scaled, opacity, g.depth, g.slope_u, g.slope_v, 0.0f, 0.0f, 0.0f
    };
#pragma unroll
    for (int k = 0; k < RECORD; k++) a.records[RECORD * i + k] = record[k];
    const int left = (int)x0 / TILE, top = (int)y0 / TILE, right = (int)x1 / TILE, bottom = (int)y1 / TILE;
    int* rectangle = a.rectangles + 4 * i;
    rectangle[0] = left, rectangle[1] = top, rectangle[2] = right, rectangle[3] = bottom;
    int count = 0;
    for (int y = top; y <= bottom; y++)
        for (int x = left; x <= right; x++) count += reaches(record, x, y);
    a.counts[i] = count;
}

struct List {
    const float* records;
    const int* rectangles;
    const long long* order;     // [n] Gaussians by depth
    const long long* ends;      // [n] sums of their counts, each one's own included
    int* tiles;                 // [room] in the order of depth; behind all tiles before
    int* owners;                // [room] the Gaussian of each
    long long room;             // pairs that there is memory for
    int n, tiles_x;
};

KERNEL(list, List) {
    const int slot = blockIdx.x * THREADS + threadIdx.x;
    if (slot >= a.n) return;
    long long at = slot ? a.ends[slot - 1] : 0;
    const long long end = a.ends[slot] < a.room ? a.ends[slot] : a.room;
    if (at >= end) return;
    const int owner = (int)a.order[slot];
    const int* rectangle = a.rectangles + 4 * owner;
    float record[6];
#pragma unroll
    for (int k = 0; k < 6; k++) record[k] = a.records[RECORD * owner + k];
    for (int y = rectangle[1]; y <= rectangle[3]; y++)
        for (int x = rectangle[0]; x <= rectangle[2]; x++)
            if (at < end && reaches(record, x, y)) {
                a.tiles[at] = y * a.tiles_x + x;
                a.owners[at++] = owner;
            }
    // Places are left if the two kernels do not round alike, which no compiler promises: they stay behind all tiles.
}

struct ProjectBackward {
    const float* means;
    const float* quats;
    const float* scales;
    const float* opacities;
    const float* pose;
    const long long* order;
    const long long* ends;
    const float* sums;          // [room, SUMS] in the order of `list`
    float* d_means;
    float* d_quats;
    float* d_scales;
    float* d_opacities;
    float* d_features;          // [n, features]
    float* d_pose;              // [blocks, 16]: twelve sums of each block
    long long room;
    int n, features;
    Camera camera;
};

// All sums have a fixed order: over a splat's pairs, over a warp, over a block's warps.
KERNEL(project_backward, ProjectBackward) {
    __shared__ float of_warps[WARPS][16];
    const int slot = blockIdx.x * THREADS + threadIdx.x;
    float d_pose[16] = {};
    if (slot < a.n) {
        const int i = (int)a.order[slot];
        const long long first = slot ? a.ends[slot - 1] : 0, end = a.ends[slot] < a.room ? a.ends[slot] : a.room;
        float m[MOMENTS] = {};
        for (long long pair = first; pair < end; pair++)
#pragma unroll
            for (int k = 0; k < MOMENTS; k++) m[k] += a.sums[pair * SUMS + k];
        for (int f = 0; f < a.features; f++) {
            float sum = 0.0f;
            for (long long pair = first; pair < end; pair++) sum += a.sums[pair * SUMS + MOMENTS + f];
            a.d_features[(long long)i * a.features + f] = sum;
        }
        float d_mean[3] = {}, d_quat[4] = {}, d_scale[3] = {}, d_opacity = 0.0f;
        if (first < end) {
            const Camera& camera = a.camera;
            const float* mean = a.means + 3 * i;
            const View g = look(mean, a.quats + 4 * i, a.scales + 3 * i, a.pose, camera);
            const Matrix& R = g.R;
            const float s = m[0], sx = m[1], sy = m[2], sxx = m[3], sxy = m[4], syy = m[5];
            const float d_z = m[6], d_plane = m[7], plane_x = m[8], plane_y = m[9];
            const float ca = (g.vv + BLUR) * g.inverse, cb = -g.uv * g.inverse, cc = (g.uu + BLUR) * g.inverse;
            d_opacity = s / a.opacities[i];

            // Footprint: d ln(alpha) = -1/2 d(offset^T conic offset). The derivatives by variances are taken twice.
            const float e00 = ca * sxx + cb * sxy, e01 = ca * sxy + cb * syy;
            const float e10 = cb * sxx + cc * sxy, e11 = cb * sxy + cc * syy;
            float d_uu = e00 * ca + e01 * cb, d_uv = e00 * cb + e01 * cc, d_vv = e10 * cb + e11 * cc;
            const float d_u = ca * sx + cb * sy - g.slope_u * d_plane, d_v = cb * sx + cc * sy - g.slope_v * d_plane;
            // Plane: slope = (cov_uv + soft)^-1 cov_z.
            const float au = g.uu + PLANE_SOFTENING, av = g.vv + PLANE_SOFTENING;
            const float d_uz = (av * plane_x - g.uv * plane_y) * g.plane_inverse;
            const float d_vz = (au * plane_y - g.uv * plane_x) * g.plane_inverse;
            d_uu -= 2 * d_uz * g.slope_u, d_vv -= 2 * d_vz * g.slope_v;
            d_uv -= d_uz * g.slope_v + d_vz * g.slope_u;

            // Covariance M M^T to the scaled axes, to scales and to unscaled axes.
            const Matrix dM = product({{{d_uu, d_uv, d_uz}, {d_uv, d_vv, d_vz}, {d_uz, d_vz, 0.0f}}}, g.M);
            Matrix dN;
#pragma unroll
            for (int k = 0; k < 3; k++) {
                d_scale[k] = dM[0][k] * g.N[0][k] + dM[1][k] * g.N[1][k] + dM[2][k] * g.N[2][k];
#pragma unroll
                for (int j = 0; j < 3; j++) dN[j][k] = dM[j][k] * g.scale[k];
            }

            // N = J R(q): to the quaternion, whose length does not matter ...
            const Matrix h = product(transposed(g.J), dN);
            const float w = g.q[0], p = g.q[1], q = g.q[2], r = g.q[3];
            d_quat[0] = 2 * (r * (h[1][0] - h[0][1]) + q * (h[0][2] - h[2][0]) + p * (h[2][1] - h[1][2]));
            d_quat[1] = 2 * (q * (h[0][1] + h[1][0]) + r * (h[0][2] + h[2][0]) + w * (h[2][1] - h[1][2])
                             - 2 * p * (h[1][1] + h[2][2]));
            d_quat[2] = 2 * (p * (h[0][1] + h[1][0]) + r * (h[1][2] + h[2][1]) + w * (h[0][2] - h[2][0])
                             - 2 * q * (h[0][0] + h[2][2]));
            d_quat[3] = 2 * (p * (h[0][2] + h[2][0]) + q * (h[1][2] + h[2][1]) + w * (h[1][0] - h[0][1])
                             - 2 * r * (h[0][0] + h[1][1]));
            float along = 0.0f;
#pragma unroll
            for (int k = 0; k < 4; k++) along += d_quat[k] * g.q[k];
#pragma unroll
            for (int k = 0; k < 4; k++) d_quat[k] = (d_quat[k] - along * g.q[k]) * g.q_inverse;

            // ... and to the rows of J.
            const Matrix dJ = product(dN, transposed(g.Q));
            const float along_uz = dJ[0][0] * R[2][0] + dJ[0][1] * R[2][1] + dJ[0][2] * R[2][2];
            const float along_vz = dJ[1][0] * R[2][0] + dJ[1][1] * R[2][1] + dJ[1][2] * R[2][2];
            const float d_ju = dJ[0][0] * R[0][0] + dJ[0][1] * R[0][1] + dJ[0][2] * R[0][2] - g.ac * along_uz;
            const float d_jv = dJ[1][0] * R[1][0] + dJ[1][1] * R[1][1] + dJ[1][2] * R[1][2] - g.bc * along_vz;
            const float d_a = d_u * camera.fx - (g.a == g.ac ? g.ju * along_uz : 0.0f);
            const float d_b = d_v * camera.fy - (g.b == g.bc ? g.jv * along_vz : 0.0f);
            const float d_x = d_a * g.iz, d_y = d_b * g.iz;
            const float d_zc = d_z + d_plane - g.iz * (d_a * g.a + d_b * g.b + d_ju * g.ju + d_jv * g.jv);
            const float ka = g.ac * g.ju, kb = g.bc * g.jv;
#pragma unroll
            for (int j = 0; j < 3; j++) {
                d_mean[j] = d_x * R[0][j] + d_y * R[1][j] + d_zc * R[2][j];
                d_pose[4 * 0 + j] = d_x * mean[j] + g.ju * dJ[0][j];
                d_pose[4 * 1 + j] = d_y * mean[j] + g.jv * dJ[1][j];
                d_pose[4 * 2 + j] = d_zc * mean[j] + dJ[2][j] - ka * dJ[0][j] - kb * dJ[1][j];
            }
            d_pose[3] = d_x, d_pose[7] = d_y, d_pose[11] = d_zc;
        }
#pragma unroll
        for (int k = 0; k < 3; k++) a.d_means[3 * i + k] = d_mean[k], a.d_scales[3 * i + k] = d_scale[k];
#pragma unroll
        for (int k = 0; k < 4; k++) a.d_quats[4 * i + k] = d_quat[k];
        a.d_opacities[i] = d_opacity;
    }
    const int lane = threadIdx.x & 31, warp = threadIdx.x / 32;
    const float sum = warp_sums(d_pose);
    if (!(lane & 1)) of_warps[warp][lane / 2] = sum;
    __syncthreads();
    if (threadIdx.x < 16) {
        float total = 0.0f;
        for (int k = 0; k < WARPS; k++) total += of_warps[k][threadIdx.x];
        a.d_pose[16 * blockIdx.x + threadIdx.x] = total;
    }
}
