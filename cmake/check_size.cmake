# cmake -DSIZE=... -DFILES=a;b -DLIMIT=bytes -P check_size.cmake
# Prints the flash size of code and constants; fails when it exceeds LIMIT.
execute_process(COMMAND ${SIZE} --totals ${FILES} OUTPUT_VARIABLE text COMMAND_ERROR_IS_FATAL ANY)
if(NOT text MATCHES "\n *([0-9]+)[ \t]+([0-9]+)[ \t]+[0-9]+[ \t]+[0-9]+[ \t]+[0-9a-f]+[ \t]+\\(TOTALS\\)")
    message(FATAL_ERROR "no totals in the output of ${SIZE}:\n${text}")
endif()
math(EXPR flash "${CMAKE_MATCH_1} + ${CMAKE_MATCH_2}") # initial values of variables are in flash as well
message(STATUS "firmware takes ${flash} of ${LIMIT} bytes of flash")
if(flash GREATER LIMIT)
    message(FATAL_ERROR "the firmware takes ${flash} bytes of flash, must be at most ${LIMIT}:\n${text}")
endif()
