// NVRTC and the CUDA driver, as far as launching.py calls them: "machine code" is the path of a library that a C++
// compiler has made of the text, with cuda.h of this folder in place of CUDA.

#include <dlfcn.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <fstream>
#include <sstream>
#include <string>

struct Program {
    std::string text, log, binary;
};

extern "C" {

int nvrtcVersion(int* major, int* minor) { return *major = 13, *minor = 5, 0; }

int nvrtcCreateProgram(Program** program, const char* text, const char* name, int headers, const char**, const char**) {
    *program = new Program{text, "", ""};
    return name && headers == 0 ? 0 : 1;
}

int nvrtcCompileProgram(Program* program, int count, const char** options) {
    if (count != 3 || std::string(options[0]) != "--gpu-architecture=sm_90") return 2;
    char folder[] = "/tmp/emulated.XXXXXX";
    const std::string base = std::string(mkdtemp(folder)) + "/kernels";
    std::ofstream(base + ".cpp") << "#include \"" << getenv("EMULATED_CUDA") << "\"\n" << program->text;
    const std::string flags = " -std=c++17 -O1 -w -shared -fPIC ", log = base + ".log";
    const std::string line = getenv("EMULATED_CXX") + flags + base + ".cpp -o " + base + ".so 2> " + log;
    const int failed = system(line.c_str());
    std::stringstream said;
    said << std::ifstream(log).rdbuf();
    program->log = said.str(), program->binary = base + ".so";
    return failed ? 6 : 0;
}

int nvrtcGetProgramLogSize(Program* program, size_t* size) { return *size = program->log.size() + 1, 0; }
int nvrtcGetProgramLog(Program* program, char* log) { return strcpy(log, program->log.c_str()), 0; }
int nvrtcGetCUBINSize(Program* program, size_t* size) { return *size = program->binary.size() + 1, 0; }
int nvrtcGetCUBIN(Program* program, char* binary) { return strcpy(binary, program->binary.c_str()), 0; }
int nvrtcDestroyProgram(Program** program) { return delete *program, *program = nullptr, 0; }

static uintptr_t current = 0;

int cuDevicePrimaryCtxRetain(uintptr_t* context, int device) { return *context = 1000 + device, 0; }
int cuCtxSetCurrent(uintptr_t context) { return current = context, 0; }

int cuModuleLoadData(void** module, const char* binary) {
    *module = dlopen(binary, RTLD_NOW);
    return *module ? 0 : 200;
}

int cuModuleGetFunction(void** function, void* module, const char* name) {
    *function = dlsym(module, name);
    return *function ? 0 : 500;
}

int cuLaunchKernel(
    void* function, unsigned x, unsigned y, unsigned z, unsigned threads, unsigned threads_y, unsigned threads_z,
    unsigned shared, void* stream, void** arguments, void** extra
) {
    const bool sound = current == 1000 && x > 0 && y == 1 && z == 1 && threads == 256 && threads_y == 1 &&
                       threads_z == 1 && shared == 0 && stream == (void*)7 && arguments && !extra;
    if (!sound) return 1;
    ((void (*)(unsigned, const void*))function)(x, arguments[0]);
    return 0;
}

int cuGetErrorString(int status, const char** text) {
    *text = status == 1 ? "invalid argument" : "something else";
    return 0;
}

}
