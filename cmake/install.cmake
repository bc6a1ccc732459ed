# Installation as a CMake package: find_package(salient) gives firmware of another project the host port, the emulator and
# the drive that it may replace parts of (cmake/salientConfig.cmake).

include(CMakePackageConfigHelpers)
include(GNUInstallDirs)

# salient_public_headers(TARGET FOLDER...): include folders of a library here, and of the same library when it is
# installed, where each folder has a copy below include/salient.
function(salient_public_headers target)
    foreach(folder ${ARGN})
        cmake_path(NORMAL_PATH folder)
        string(REGEX REPLACE "/$" "" folder ${folder})
        if(folder STREQUAL "${PROJECT_SOURCE_DIR}/hal")
            set(name hal)
        elseif(folder STREQUAL "${PROJECT_SOURCE_DIR}/firmware")
            set(name firmware)
        elseif(folder STREQUAL "${PROJECT_SOURCE_DIR}/emulator")
            set(name emulator)
        else()
            set(name generated)
        endif()
        target_include_directories(${target} PUBLIC $<BUILD_INTERFACE:${folder}>
                                                    $<INSTALL_INTERFACE:${CMAKE_INSTALL_INCLUDEDIR}/salient/${name}>)
    endforeach()
endfunction()

# salient_install(): what cmake --install copies.
function(salient_install)
    set(config ${CMAKE_INSTALL_LIBDIR}/cmake/salient)
    set(headers ${CMAKE_INSTALL_INCLUDEDIR}/salient)
    set(libraries drive_codec salient_firmware salient_plant_objects rig_codec salient_rig salient_options
                  salient_machine_image salient_machine_tables salient_port)
    foreach(library ${libraries})
        string(REGEX REPLACE "^salient_" "" name ${library})
        set_target_properties(${library} PROPERTIES EXPORT_NAME ${name})
    endforeach()
    install(TARGETS ${libraries} EXPORT salient ARCHIVE DESTINATION ${CMAKE_INSTALL_LIBDIR}/salient)
    install(EXPORT salient NAMESPACE salient:: FILE salientTargets.cmake DESTINATION ${config})
    foreach(folder hal firmware emulator)
        install(DIRECTORY ${PROJECT_SOURCE_DIR}/${folder}/ DESTINATION ${headers}/${folder} FILES_MATCHING PATTERN "*.h"
                PATTERN "*.def" PATTERN "qemu" EXCLUDE PATTERN "stm32g4" EXCLUDE PATTERN "skeleton" EXCLUDE
                PATTERN "fmi" EXCLUDE)
    endforeach()
    install(DIRECTORY ${PROJECT_BINARY_DIR}/firmware/codec/ ${PROJECT_BINARY_DIR}/firmware/dictionary/
                      ${PROJECT_BINARY_DIR}/emulator/codec/ ${PROJECT_BINARY_DIR}/emulator/host/generated/
            DESTINATION ${headers}/generated FILES_MATCHING PATTERN "*.h")
    install(FILES ${PROJECT_SOURCE_DIR}/emulator/host/main.c ${PROJECT_SOURCE_DIR}/emulator/host/host_drive.c
            DESTINATION ${config})
    install(FILES ${PROJECT_SOURCE_DIR}/firmware/comms/drive.dbc ${PROJECT_SOURCE_DIR}/emulator/rig/rig.dbc
            DESTINATION ${CMAKE_INSTALL_DATADIR}/salient)
    write_basic_package_version_file(${PROJECT_BINARY_DIR}/salientConfigVersion.cmake COMPATIBILITY SameMinorVersion)
    install(FILES ${PROJECT_SOURCE_DIR}/cmake/salientConfig.cmake ${PROJECT_BINARY_DIR}/salientConfigVersion.cmake
            DESTINATION ${config})
endfunction()
