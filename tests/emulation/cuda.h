// CUDA's blocks on a CPU, one block at a time: each thread is a fiber, which goes on until it waits for others.
// Enough for our kernels: shared memory, barriers, votes and shuffles of whole warps. Slow, exact, and single-threaded.

#include <math.h>
#include <setjmp.h>
#include <stdint.h>
#include <string.h>
#include <ucontext.h>

#include <functional>
#include <vector>

#define __device__
#define __shared__ static

struct Index {
    unsigned x;
};
static Index threadIdx, blockIdx;

namespace emulation {

constexpr unsigned SIZE = 256, STACK = 1 << 16;

struct Fiber {
    ucontext_t first;
    jmp_buf here;
    std::vector<char> stack = std::vector<char>(STACK);
    bool begun = false, done = true;
    unsigned long met[2] = {0, 0};  // how often it has waited for its warp, and for its block
};

static Fiber fibers[SIZE];
static jmp_buf scheduler;
static const std::function<void()>* body;
static uint32_t said[2][2][SIZE];  // by whom it was for, in turns: nobody is two turns ahead

// Going on by longjmp: swapcontext asks the kernel for the mask of signals each time, which takes ten times as long.
static void leave() {
    if (!_setjmp(fibers[threadIdx.x].here)) _longjmp(scheduler, 1);
}

static void run() {
    for (;;) {
        (*body)();
        fibers[threadIdx.x].done = true;
        leave();
    }
}

static void go_on(Fiber& fiber) {
    if (_setjmp(scheduler)) return;
    if (fiber.begun) _longjmp(fiber.here, 1);
    fiber.begun = true;
    getcontext(&fiber.first);
    fiber.first.uc_stack.ss_sp = fiber.stack.data(), fiber.first.uc_stack.ss_size = STACK;
    fiber.first.uc_link = nullptr;
    makecontext(&fiber.first, run, 0);
    setcontext(&fiber.first);
}

// Tells the others of a warp (0) or block (1), and waits until all of them have told as often.
static const uint32_t* meet(int group, uint32_t value) {
    const unsigned self = threadIdx.x, size = group ? SIZE : 32, first = self / size * size;
    const unsigned long turn = ++fibers[self].met[group];
    said[group][turn & 1][self] = value;
    for (unsigned k = first; k < first + size; k++)
        while (!fibers[k].done && fibers[k].met[group] < turn) leave();
    return said[group][turn & 1] + first;
}

static void emulate(unsigned blocks, const std::function<void()>& kernel) {
    body = &kernel;
    for (blockIdx.x = 0; blockIdx.x < blocks; blockIdx.x++) {
        for (Fiber& fiber : fibers) fiber.done = false, fiber.met[0] = fiber.met[1] = 0;
        memset(said, 0, sizeof said);
        for (bool going = true; going;) {
            going = false;
            for (threadIdx.x = 0; threadIdx.x < SIZE; threadIdx.x++)
                if (!fibers[threadIdx.x].done) {
                    go_on(fibers[threadIdx.x]);
                    going = true;
                }
        }
    }
}

}  // namespace emulation

static void __syncthreads() { emulation::meet(1, 0); }

static int __syncthreads_count(int predicate) {
    const uint32_t* all = emulation::meet(1, predicate != 0);
    int count = 0;
    for (unsigned k = 0; k < emulation::SIZE; k++) count += all[k];
    return count;
}

static int __any_sync(unsigned, int predicate) {
    const uint32_t* all = emulation::meet(0, predicate != 0);
    for (unsigned k = 0; k < 32; k++)
        if (all[k]) return 1;
    return 0;
}

static float __shfl_xor_sync(unsigned, float value, int mask) {
    uint32_t bits;
    memcpy(&bits, &value, 4);
    bits = emulation::meet(0, bits)[(threadIdx.x & 31) ^ mask];
    memcpy(&value, &bits, 4);
    return value;
}

static int atomicMax(int* place, int value) {
    const int before = *place;
    if (value > before) *place = value;
    return before;
}

#define KERNEL(name, Arguments)                                                 \
    static void name##_of_a_thread(const Arguments& a);                         \
    extern "C" void name(unsigned blocks, const Arguments* a) {                 \
        emulation::emulate(blocks, [a] { name##_of_a_thread(*a); });            \
    }                                                                           \
    static void name##_of_a_thread(const Arguments& a)
