// The pool hands out every item once and survives tasks that throw.
#include <sys/wait.h>
#include <unistd.h>

#include <atomic>
#include <stdexcept>
#include <thread>

#include "../engine/thread_pool.h"
#include "check.h"

namespace aomgen::tests {

TEST(every_item_is_handed_out_once) {
  for (int threads : {1, 2, 5})
    for (int64_t count : {0, 1, 7, 1000})
      for (int64_t grain : {1, 3, 2000}) {
        std::vector<std::atomic<int>> seen(static_cast<size_t>(count));
        std::atomic<bool> worker_good{true};
        parallel(threads, count, grain, [&](int64_t item, int worker) {
          ++seen[static_cast<size_t>(item)];
          if (worker < 0 || worker >= threads) worker_good = false;
        });
        bool once = worker_good;
        for (const std::atomic<int>& times : seen) once &= times == 1;
        CHECK(once);
      }
}

TEST(an_exception_reaches_the_caller_and_the_pool_goes_on) {
  for (int round = 0; round < 200; ++round)
    for (int threads : {1, 2, 4}) {
      std::atomic<int> done{0};
      bool caught = false;
      try {
        parallel(threads, 100, 1, [&](int64_t item, int) {
          if (item % 10 == round % 10) throw std::length_error("wanted");
          ++done;
        });
      } catch (const std::length_error&) {
        caught = true;
      }
      CHECK(caught && done < 100);
      done = 0;
      parallel(threads, 50, 1, [&](int64_t, int) { ++done; });
      CHECK(done == 50);
    }
}

// The own locks of the sanitizers, and of the emulator in which ARM is tested, do not survive a fork.
#if !defined(__SANITIZE_ADDRESS__) && !defined(__SANITIZE_THREAD__) && !defined(__aarch64__)
TEST(a_child_forked_while_others_work_has_a_pool) {
  std::atomic<bool> stop{false};
  const auto work = [&stop] {
    while (!stop) parallel(2, 2, 1, [](int64_t, int) {});
  };
  std::thread others[] = {std::thread(work), std::thread(work)};
  int hung = 0;
  for (int i = 0; i < 200 && !hung; ++i) {
    const pid_t child = fork();
    if (child == 0) {
      alarm(5);  // ends a child that hangs
      std::atomic<int> done{0};
      parallel(2, 50, 1, [&](int64_t, int) { ++done; });
      _exit(done == 50 ? 0 : 1);
    }
    int status = -1;
    hung += child < 0 || waitpid(child, &status, 0) != child || status != 0;
  }
  stop = true;
  for (std::thread& other : others) other.join();
  CHECK(hung == 0);
}
#endif

}  // namespace aomgen::tests
