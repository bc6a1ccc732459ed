# Generated sources: CAN codecs from the DBC files, machine data from the machine files.

set(SALIENT_GENERATOR_SOURCES ${CMAKE_SOURCE_DIR}/tools/src/salient)

# All that a drive is built for: the shipped machines, and one more where it is asked for.
if(SALIENT_MACHINE_FILE AND NOT EXISTS ${SALIENT_MACHINE_FILE})
    message(FATAL_ERROR "SALIENT_MACHINE_FILE: ${SALIENT_MACHINE_FILE}: no such file")
endif()
file(GLOB SALIENT_SHIPPED_MACHINE_FILES CONFIGURE_DEPENDS ${CMAKE_SOURCE_DIR}/tools/machines/*.toml)
set(SALIENT_MACHINE_FILES ${SALIENT_SHIPPED_MACHINE_FILES} ${SALIENT_MACHINE_FILE})

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
        COMMAND ${CMAKE_COMMAND} -E env PYTHONPATH=${CMAKE_SOURCE_DIR}/tools/src ${SALIENT_PYTHON} -m salient.generate_codec ${flags} ${dbc} ${out}
        DEPENDS ${dbc} ${SALIENT_GENERATOR_SOURCES}/generate_codec.py
        COMMENT "CAN codec from ${name}.dbc"
        VERBATIM)
    add_library(${target} STATIC ${out}/${name}_codec.c)
    target_include_directories(${target} PUBLIC ${out})
endfunction()

# salient_generate_machine(NAME FILE): sets <NAME>_TABLES and <NAME>_PLANT to the C sources generated from FILE.
function(salient_generate_machine name file)
    set(out ${CMAKE_CURRENT_BINARY_DIR}/machine_${name})
    add_custom_command(
        OUTPUT ${out}/machine_tables.c ${out}/machine_plant.c
        COMMAND ${CMAKE_COMMAND} -E env PYTHONPATH=${CMAKE_SOURCE_DIR}/tools/src ${SALIENT_PYTHON} -m salient.generate_machine ${file} ${out}
        DEPENDS ${file} ${SALIENT_GENERATOR_SOURCES}/generate_machine.py ${SALIENT_GENERATOR_SOURCES}/machine.py
                ${SALIENT_GENERATOR_SOURCES}/magnetics.py ${SALIENT_GENERATOR_SOURCES}/flux_map.py
                ${SALIENT_GENERATOR_SOURCES}/flux_map_file.py ${SALIENT_GENERATOR_SOURCES}/phase_map.py
        DEPFILE ${out}/machine.d # of a map: its CSV file
        COMMENT "machine ${name}"
        VERBATIM)
    set(${name}_TABLES ${out}/machine_tables.c PARENT_SCOPE)
    set(${name}_PLANT ${out}/machine_plant.c PARENT_SCOPE)
endfunction()
