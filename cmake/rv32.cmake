set(CMAKE_SYSTEM_NAME Generic)
set(CMAKE_SYSTEM_PROCESSOR rv32)
set(SALIENT_BOARD rv32_virt) # a folder of hal/qemu/
set(CMAKE_C_COMPILER riscv64-unknown-elf-gcc) # for RV32 as well
set(CMAKE_TRY_COMPILE_TARGET_TYPE STATIC_LIBRARY)
# Debian's compiler has no C library; c_library has the few functions that the firmware uses.
set(c_library ${CMAKE_CURRENT_LIST_DIR}/../hal/qemu/rv32_virt/c_library)
# Soft float on purpose: floating point left in the firmware shows as a call to a helper (check_symbols.cmake). In this
# version of the specification the control register instructions belong to the base instruction set, and the compiler
# finds its library for rv32imac.
set(CMAKE_C_FLAGS_INIT "-march=rv32imac -misa-spec=2.2 -mabi=ilp32 -ffreestanding -ffunction-sections -fdata-sections -isystem ${c_library}")
set(CMAKE_C_FLAGS_RELEASE "-O2" CACHE STRING "as for the Cortex-M4")
set(CMAKE_EXE_LINKER_FLAGS_INIT -nolibc)
