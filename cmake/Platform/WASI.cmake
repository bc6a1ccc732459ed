# CMake 3.25 does not know WASI: static libraries and executables, with the rules of every Unix compiler.
set(CMAKE_EXECUTABLE_SUFFIX .wasm)
