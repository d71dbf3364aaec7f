// One step of Adam on a table of the Gaussians' parameters, as mapping/optimizer.py has it: one entry a thread.

struct Adam {
    float* parameters;              // [n, width]
    const float* gradient;
    float* first;                   // the gradient's running mean
    float* second;                  // that of its square
    const int* steps;               // [n] of each row, this one included
    const unsigned char* visible;   // [n] rows that take part; null for all
    const float* gradient_scale;    // [n] or null
    const float* step_scale;        // [n] or null
    const float* pace;              // factor on the rates
    int n, width;
    int head;                       // of a row, entries with the full rate
    float rate, tail_rate;
};

KERNEL(adam, Adam) {
    const int at = blockIdx.x * THREADS + threadIdx.x, row = at / a.width;
    if (row >= a.n || (a.visible && !a.visible[row])) return;
    float g = a.gradient[at];
    if (!(fabsf(g) <= 3.4e38f)) g = 0.0f;  // one bad pixel must not end a map
    if (a.gradient_scale) g *= a.gradient_scale[row];
    const float steps = a.steps[row], first = BETA_1 * a.first[at] + (1.0f - BETA_1) * g;
    const float second = BETA_2 * a.second[at] + (1.0f - BETA_2) * g * g;
    a.first[at] = first, a.second[at] = second;
    // 1 - beta^steps, which is small at first.
    const float young_1 = -expm1f(steps * LOG_BETA_1), young_2 = -expm1f(steps * LOG_BETA_2);
    float step = first / young_1 / (sqrtf(second / young_2) + EPSILON);
    if (a.step_scale) step *= a.step_scale[row];
    a.parameters[at] -= *a.pace * (at % a.width < a.head ? a.rate : a.tail_rate) * step;
}
