// Contract of the host's port (hal/) on its board: the watchdog.
#include "support/emulated_board.h"

extern "C" {
#include "hal_nvm.h"
#include "hal_watchdog.h"
#include "host/hal_host.h"
}

namespace {

constexpr uint64_t NS_PER_US = 1000, TIMEOUT_NS = HAL_WATCHDOG_TIMEOUT_US * NS_PER_US;

class HalHost : public EmulatedBoard {
  protected:
    HalHost() {
        nvm_init(&board.nvm);
        board.context = BOARD_BACKGROUND;
    }

    hal_t hal{&board};
};

TEST_F(HalHost, an_erasure_kicks_the_watchdog_and_a_word_does_not) {
    hal_watchdog_start(&hal);
    EXPECT_EQ(board.watchdog_ns, TIMEOUT_NS);
    board.time_ns = 5000 * NS_PER_US;
    EXPECT_TRUE(hal_nvm_program(&hal, 0, 0, 1));
    EXPECT_EQ(hal_nvm_read(&hal, 0, 0), 1u);
    EXPECT_EQ(board.watchdog_ns, TIMEOUT_NS);
    EXPECT_TRUE(hal_nvm_erase(&hal, 0));
    EXPECT_EQ(board.watchdog_ns, TIMEOUT_NS + 5000 * NS_PER_US);
    board.time_ns = 7000 * NS_PER_US;
    hal_watchdog_kick(&hal);
    EXPECT_EQ(board.watchdog_ns, TIMEOUT_NS + 7000 * NS_PER_US);
}

TEST_F(HalHost, nothing_but_its_start_starts_the_watchdog) {
    const uint64_t never = board.watchdog_ns;
    EXPECT_GT(never, UINT64_MAX / 2);
    hal_watchdog_kick(&hal);
    EXPECT_TRUE(hal_nvm_erase(&hal, 0));
    EXPECT_EQ(board.watchdog_ns, never);
}

} // namespace
