# find_package(salient): libraries of the drive and of its emulated test bench for Linux on this processor.
#
#   salient::port            host port of the HAL, emulated rig, CAN and command line: everything but a main function and
#                            the firmware
#   salient::firmware        the drive
#   salient::machine_tables  reads the tables of the drive from a machine image
#
# and what they need. The include folders are the repository's: "hal.h", "drive.h", "host/simulation.h", ...

include(${CMAKE_CURRENT_LIST_DIR}/salientTargets.cmake)
set(SALIENT_MAIN ${CMAKE_CURRENT_LIST_DIR}/main.c ${CMAKE_CURRENT_LIST_DIR}/host_drive.c)

# salient_add_drive(TARGET LAW.c...): an executable of the drive on its test bench, with these files in place of the
# firmware's that define the same functions: a file defines all functions of the one that it replaces. Files of other
# names are added. As the firmware they are integer only, which the compiler checks on x86-64. The executable has the
# command line and the CAN messages of the original, and pytest --salient-program tests it.
function(salient_add_drive target)
    add_executable(${target} ${SALIENT_MAIN} ${ARGN})
    target_compile_features(${target} PRIVATE c_std_11)
    target_link_libraries(${target} PRIVATE salient::machine_tables salient::firmware salient::port)
    target_link_options(${target} PRIVATE -fno-lto) # the libraries may be of another version of the compiler
    if(CMAKE_SYSTEM_PROCESSOR MATCHES "x86_64|AMD64")
        set_source_files_properties(${ARGN} PROPERTIES COMPILE_OPTIONS -mgeneral-regs-only)
    endif()
endfunction()
