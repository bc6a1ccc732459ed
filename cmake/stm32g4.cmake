# The processor of cmake/cortex-m4.cmake, on the board NUCLEO-G474RE.
include(${CMAKE_CURRENT_LIST_DIR}/cortex-m4.cmake)
unset(SALIENT_BOARD)
set(SALIENT_PORT stm32g4) # a folder of hal/
