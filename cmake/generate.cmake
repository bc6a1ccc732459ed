# Generated sources: CAN codecs from the DBC files, machine data from the machine files.

set(SALIENT_GENERATOR_SOURCES ${CMAKE_SOURCE_DIR}/tools/src/salient)
set(SALIENT_GENERATOR ${CMAKE_COMMAND} -E env PYTHONPATH=${CMAKE_SOURCE_DIR}/tools/src ${SALIENT_PYTHON} -m)

# Machines that drives are built for: the bundled ones, and one more on request.
if(SALIENT_MACHINE_FILE AND NOT EXISTS ${SALIENT_MACHINE_FILE})
    message(FATAL_ERROR "SALIENT_MACHINE_FILE: ${SALIENT_MACHINE_FILE}: no such file")
endif()
file(GLOB bundled CONFIGURE_DEPENDS ${CMAKE_SOURCE_DIR}/tools/machines/*.toml)
list(TRANSFORM bundled REPLACE ".*/([^/]*)\\.toml$" "\\1" OUTPUT_VARIABLE SALIENT_BUNDLED_MACHINES)
set(SALIENT_MACHINES ${SALIENT_BUNDLED_MACHINES})
if(SALIENT_MACHINE_FILE)
    get_filename_component(name ${SALIENT_MACHINE_FILE} NAME_WE)
    list(APPEND SALIENT_MACHINES ${name})
endif()

# salient_generate_codec(TARGET DBC [INTEGER]): a static library with <name>.h/.c generated from DBC.
# INTEGER leaves every floating-point conversion out.
function(salient_generate_codec target dbc)
    cmake_parse_arguments(ARG "INTEGER" "" "" ${ARGN})
    get_filename_component(name ${dbc} NAME_WE)
    set(out ${CMAKE_CURRENT_BINARY_DIR}/codec)
    set(flags)
    if(ARG_INTEGER)
        set(flags --integer)
    endif()
    add_custom_command(
        OUTPUT ${out}/${name}_codec.c ${out}/${name}_codec.h
        COMMAND ${SALIENT_GENERATOR} salient.generate.codec ${flags} ${dbc} ${out}
        DEPENDS ${dbc} ${SALIENT_GENERATOR_SOURCES}/generate/codec.py
        COMMENT "CAN codec from ${name}.dbc"
        VERBATIM)
    add_library(${target} STATIC ${out}/${name}_codec.c)
    target_include_directories(${target} PUBLIC ${out})
endfunction()

# salient_generate_bench_variables(TARGET DBC): an interface library with bench_variables.h, the table of the bench
# variables in DBC.
function(salient_generate_bench_variables target dbc)
    set(out ${CMAKE_CURRENT_BINARY_DIR}/${target})
    add_custom_command(
        OUTPUT ${out}/bench_variables.h
        COMMAND ${SALIENT_GENERATOR} salient.generate.bench_variables ${dbc} ${out}
        DEPENDS ${dbc} ${SALIENT_GENERATOR_SOURCES}/generate/bench_variables.py
                ${SALIENT_GENERATOR_SOURCES}/generate/codec.py
        COMMENT "bench variables"
        VERBATIM)
    add_custom_target(${target}_header DEPENDS ${out}/bench_variables.h)
    add_library(${target} INTERFACE)
    add_dependencies(${target} ${target}_header)
    target_include_directories(${target} INTERFACE ${out})
endfunction()

# salient_add_machines(): for each machine file the object libraries <name>_tables (firmware/control/machine_tables.h)
# and <name>_plant (emulator/plant/machine.h), generated and compiled once for all programs of the build.
function(salient_add_machines)
    file(GLOB generator_sources CONFIGURE_DEPENDS ${SALIENT_GENERATOR_SOURCES}/machine/*.py)
    foreach(name ${SALIENT_MACHINES})
        set(file ${CMAKE_SOURCE_DIR}/tools/machines/${name}.toml)
        if(NOT name IN_LIST SALIENT_BUNDLED_MACHINES)
            set(file ${SALIENT_MACHINE_FILE})
        endif()
        set(out ${CMAKE_BINARY_DIR}/machine/${name})
        add_custom_command(
            OUTPUT ${out}/machine_tables.c ${out}/machine_plant.c
            COMMAND ${SALIENT_GENERATOR} salient.generate.machine ${file} ${out}
            DEPENDS ${file} ${SALIENT_GENERATOR_SOURCES}/generate/machine.py ${generator_sources}
            DEPFILE ${out}/machine.d # of a map: its CSV file
            COMMENT "machine ${name}"
            VERBATIM)
        add_library(${name}_tables OBJECT ${out}/machine_tables.c)
        target_include_directories(${name}_tables PRIVATE ${CMAKE_SOURCE_DIR}/firmware)
        if(CMAKE_SYSTEM_NAME STREQUAL "Linux")
            add_library(${name}_plant OBJECT ${out}/machine_plant.c)
            target_include_directories(${name}_plant PRIVATE ${CMAKE_SOURCE_DIR}/emulator)
            # A functional mock-up unit exports nothing but the functions of its standard.
            set_target_properties(${name}_plant PROPERTIES C_VISIBILITY_PRESET hidden)
            add_dependencies(${name}_plant ${name}_tables) # one run of the generator
        endif()
    endforeach()
endfunction()
