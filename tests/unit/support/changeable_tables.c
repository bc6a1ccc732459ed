/* The tables of the bundled machine in a variable, for tests that run the drive with other tables: machine_tables, by
 * its linker name. BUNDLED_TABLES: the generated source. */
#include "control/machine_tables.h"

#define machine_tables bundled_tables
#include BUNDLED_TABLES
#undef machine_tables

machine_tables_t changeable_tables __asm__("machine_tables");

__attribute__((constructor)) static void copy(void) {
    changeable_tables = bundled_tables;
}
