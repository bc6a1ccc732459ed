# cmake -DNM=... -DARCHIVES=a;b -P check_symbols.cmake
# Fails when the firmware references a symbol other than the HAL, memcpy and memset, the machine's tables and the
# compiler's integer helpers, for example a floating-point helper (__aeabi_fadd, __aeabi_d2iz, ...), malloc or printf, or
# a 64-bit division (firmware/fixed/divide.h has one).
set(allowed "^(hal_[a-z0-9_]+|machine_tables|memcpy|memset|__aeabi_(uidiv|idiv|uidivmod|idivmod|lmul|llsl|llsr|lasr|memcpy[48]?|memset[48]?|memclr[48]?)|__(ashl|ashr|lshr)di3|__clz[sd]i2)$")

set(defined)
set(needed)
foreach(archive ${ARCHIVES})
    execute_process(COMMAND ${NM} --defined-only --extern-only --format=posix ${archive} OUTPUT_VARIABLE text
                    COMMAND_ERROR_IS_FATAL ANY)
    string(REGEX MATCHALL "[A-Za-z_0-9.]+ [A-Z] " lines "${text}")
    list(APPEND defined ${lines})
    execute_process(COMMAND ${NM} --undefined-only --format=posix ${archive} OUTPUT_VARIABLE text
                    COMMAND_ERROR_IS_FATAL ANY)
    string(REGEX MATCHALL "[A-Za-z_0-9.]+ U " lines "${text}")
    list(APPEND needed ${lines})
endforeach()
list(TRANSFORM defined REPLACE " .*" "")
list(TRANSFORM needed REPLACE " .*" "")
list(REMOVE_DUPLICATES needed)
list(REMOVE_ITEM needed ${defined})

set(forbidden ${needed})
list(FILTER forbidden EXCLUDE REGEX "${allowed}")
if(forbidden)
    list(JOIN forbidden ", " names)
    message(FATAL_ERROR "the firmware references what it must not: ${names}")
endif()
list(JOIN needed " " names)
message(STATUS "firmware references only: ${names}")
