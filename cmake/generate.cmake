# Generated sources: CAN codecs from the DBC files, machine data from the machine files.

set(SALIENT_GENERATOR_SOURCES ${CMAKE_SOURCE_DIR}/tools/src/salient)
set(SALIENT_GENERATOR ${CMAKE_COMMAND} -E env PYTHONPATH=${CMAKE_SOURCE_DIR}/tools/src ${SALIENT_PYTHON} -m)

set(SALIENT_CODEC_GENERATOR generate/codec.py generate/enumerations.py generate/telemetry.py generate/error.py
    generate/files.py generate/ranges.py dbc.py)
list(TRANSFORM SALIENT_CODEC_GENERATOR PREPEND ${SALIENT_GENERATOR_SOURCES}/)

# Machines that images for a board, functional mock-up units and tests are built for: the bundled ones, and one more,
# "custom", on request.
if(SALIENT_MACHINE_FILE AND NOT EXISTS ${SALIENT_MACHINE_FILE})
    message(FATAL_ERROR "SALIENT_MACHINE_FILE: ${SALIENT_MACHINE_FILE}: no such file")
endif()
file(GLOB bundled CONFIGURE_DEPENDS ${CMAKE_SOURCE_DIR}/tools/machines/*.toml)
list(TRANSFORM bundled REPLACE ".*/([^/]*)\\.toml$" "\\1" OUTPUT_VARIABLE SALIENT_BUNDLED_MACHINES)
set(SALIENT_MACHINES ${SALIENT_BUNDLED_MACHINES})
if(SALIENT_MACHINE_FILE)
    list(APPEND SALIENT_MACHINES custom)
endif()

# salient_generate_codec(TARGET DBC [INTEGER] [NODE name] [PHASES n]): a static library with <name>_codec.h/.c generated
# from DBC. INTEGER leaves every floating-point conversion out. NODE adds <name>_enumerations.h, and
# <name>_telemetry.h/.c with the cyclic messages of that node. PHASES leaves messages out that only machines of more
# phases have.
function(salient_generate_codec target dbc)
    cmake_parse_arguments(ARG "INTEGER" "NODE;PHASES" "" ${ARGN})
    get_filename_component(name ${dbc} NAME_WE)
    set(out ${CMAKE_CURRENT_BINARY_DIR}/codec)
    set(outputs ${out}/${name}_codec.c ${out}/${name}_codec.h)
    set(sources ${out}/${name}_codec.c)
    set(flags)
    if(ARG_INTEGER)
        list(APPEND flags --integer)
    endif()
    if(ARG_PHASES)
        list(APPEND flags --phases ${ARG_PHASES})
    endif()
    if(ARG_NODE)
        list(APPEND flags --node ${ARG_NODE})
        list(APPEND outputs ${out}/${name}_enumerations.h ${out}/${name}_telemetry.c ${out}/${name}_telemetry.h)
        list(APPEND sources ${out}/${name}_telemetry.c)
    endif()
    add_custom_command(
        OUTPUT ${outputs}
        COMMAND ${SALIENT_GENERATOR} salient.generate.codec ${flags} ${dbc} ${out}
        DEPENDS ${dbc} ${SALIENT_CODEC_GENERATOR}
        COMMENT "CAN codec from ${name}.dbc"
        VERBATIM)
    add_library(${target} STATIC ${sources})
    salient_public_headers(${target} ${out})
endfunction()

# salient_generate_rig_table(TARGET NAME DBC): an interface library with NAME.h, the table that salient.generate.NAME
# makes of DBC: bench_variables or fault_kinds.
function(salient_generate_rig_table target name dbc)
    set(out ${CMAKE_CURRENT_BINARY_DIR}/${target})
    add_custom_command(
        OUTPUT ${out}/${name}.h
        COMMAND ${SALIENT_GENERATOR} salient.generate.${name} ${dbc} ${out}
        DEPENDS ${dbc} ${SALIENT_GENERATOR_SOURCES}/generate/${name}.py ${SALIENT_CODEC_GENERATOR}
        COMMENT "${name}"
        VERBATIM)
    add_custom_target(${target}_header DEPENDS ${out}/${name}.h)
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
            OUTPUT ${out}/machine_tables.c ${out}/machine_plant.c ${out}/machine.image
            COMMAND ${SALIENT_GENERATOR} salient.generate.machine ${file} ${out}
            DEPENDS ${file} ${SALIENT_GENERATOR_SOURCES}/generate/machine.py ${SALIENT_CODEC_GENERATOR}
                    ${generator_sources}
            DEPFILE ${out}/machine.d # parameters, DBC, of a map: its CSV file
            COMMENT "machine ${name}"
            VERBATIM)
        add_library(${name}_tables OBJECT ${out}/machine_tables.c)
        target_include_directories(${name}_tables PRIVATE ${CMAKE_SOURCE_DIR}/firmware)
        target_compile_definitions(${name}_tables PRIVATE ${SALIENT_TABLES_DEFINITION})
        if(CMAKE_C_COMPILER_ID STREQUAL "GNU") # the laws are compiled for this machine's constants when a drive is linked
            target_compile_options(${name}_tables PRIVATE $<$<CONFIG:Release>:-flto=auto -ffat-lto-objects>)
        endif()
        if(CMAKE_SYSTEM_NAME STREQUAL "Linux")
            add_library(${name}_plant OBJECT ${out}/machine_plant.c)
            target_include_directories(${name}_plant PRIVATE ${CMAKE_SOURCE_DIR}/emulator)
            # A functional mock-up unit exports nothing but the functions of its standard.
            set_target_properties(${name}_plant PROPERTIES C_VISIBILITY_PRESET hidden)
            add_dependencies(${name}_plant ${name}_tables) # one run of the generator
        endif()
    endforeach()
endfunction()
