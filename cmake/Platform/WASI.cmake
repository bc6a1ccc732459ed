# CMake 3.25 does not know WASI: static libraries and executables, with the rules of every Unix compiler.
