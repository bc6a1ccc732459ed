set(CMAKE_SYSTEM_NAME Generic)
set(CMAKE_SYSTEM_PROCESSOR cortex-m4)
set(SALIENT_BOARD mps2_an386) # a folder of hal/qemu/
set(CMAKE_C_COMPILER arm-none-eabi-gcc)
set(SALIENT_SIZE arm-none-eabi-size)
set(CMAKE_TRY_COMPILE_TARGET_TYPE STATIC_LIBRARY)
# Soft float on purpose: floating point left in the firmware shows as a call to a helper (check_symbols.cmake).
set(CMAKE_C_FLAGS_INIT "-mcpu=cortex-m4 -mthumb -mfloat-abi=soft -ffreestanding -ffunction-sections -fdata-sections")
set(CMAKE_C_FLAGS_RELEASE "-O2" CACHE STRING "optimised for a target whose flash is small")
