#include "thread_pool.h"

#include <atomic>
#include <condition_variable>
#include <exception>
#include <mutex>
#include <system_error>
#include <thread>
#include <vector>

#if defined(__linux__)
#include <sched.h>
#endif
#include <unistd.h>

namespace aomgen {

int processor_count() {
#if defined(__linux__)
  cpu_set_t set;
  if (sched_getaffinity(0, sizeof(set), &set) == 0) {
    const int count = CPU_COUNT(&set);
    if (count > 0) return count;
  }
#endif
  const int count = static_cast<int>(std::thread::hardware_concurrency());
  return count > 0 ? count : 1;
}

namespace {

struct Job {
  Task task;
  void* context;
  int64_t count, grain;
  std::atomic<int64_t> next{0};
  std::mutex failing{};
  std::exception_ptr failure{};  // the first; the items left are given up then

  void run(int worker) {
    try {
      run_items(worker);
    } catch (...) {  // kept for the caller: other threads may still be at work on its behalf
      next = count;
      std::lock_guard<std::mutex> lock(failing);
      if (!failure) failure = std::current_exception();
    }
  }

  void run_items(int worker) {
    for (;;) {
      const int64_t first = next.fetch_add(grain, std::memory_order_relaxed);
      if (first >= count) return;
      const int64_t last = first + grain < count ? first + grain : count;
      for (int64_t item = first; item < last; ++item) task(context, item, worker);
    }
  }
};

class Pool {
 public:
  const pid_t process = getpid();

  bool try_run(int threads, Job& job) {
    std::unique_lock<std::mutex> one_caller(caller_, std::try_to_lock);
    if (!one_caller.owns_lock()) return false;
    const int helpers = hire(threads - 1);
    {
      std::lock_guard<std::mutex> lock(state_);
      job_ = &job;
      invited_ = helpers;
      ++round_;
    }
    start_.notify_all();
    job.run(0);
    std::unique_lock<std::mutex> lock(state_);
    job_ = nullptr;  // a helper that wakes up only now is not waited for
    done_.wait(lock, [this] { return busy_ == 0; });
    return true;
  }

 private:
  // As many helpers as wanted, or as the system allows.
  int hire(int wanted) {
    try {
      while (static_cast<int>(threads_.size()) < wanted) {
        const int worker = static_cast<int>(threads_.size()) + 1;
        threads_.emplace_back([this, worker] { serve(worker); });
        threads_.back().detach();
      }
    } catch (const std::system_error&) {
      return static_cast<int>(threads_.size());
    }
    return wanted;
  }

  void serve(int worker) {
    uint64_t seen = 0;
    for (;;) {
      Job* job = nullptr;
      {
        std::unique_lock<std::mutex> lock(state_);
        start_.wait(lock, [&] { return round_ != seen; });
        seen = round_;
        if (worker > invited_ || !job_) continue;
        job = job_;
        ++busy_;
      }
      job->run(worker);
      std::lock_guard<std::mutex> lock(state_);
      if (--busy_ == 0) done_.notify_one();
    }
  }

  std::mutex caller_, state_;
  std::condition_variable start_, done_;
  std::vector<std::thread> threads_;
  Job* job_ = nullptr;
  uint64_t round_ = 0;
  int invited_ = 0, busy_ = 0;
};

// A forked child has none of its parent's threads, so every process makes its own pool. Pools live
// until the process ends: their threads may not outlive them. No mutex, which a fork could find locked.
Pool& pool_of_this_process() {
  static std::atomic<Pool*> current{nullptr};
  Pool* pool = current;
  while (!pool || pool->process != getpid()) {
    Pool* fresh = new Pool();
    if (current.compare_exchange_strong(pool, fresh)) return *fresh;
    delete fresh;  // another thread was faster
  }
  return *pool;
}

}  // namespace

void parallel_for(int threads, int64_t count, int64_t grain, Task task, void* context) {
  Job job{task, context, count, grain};
  const int64_t groups = (count + grain - 1) / grain;
  if (threads > groups) threads = static_cast<int>(groups);
  if (threads <= 1 || !pool_of_this_process().try_run(threads, job)) job.run(0);
  if (job.failure) std::rethrow_exception(job.failure);
}

}  // namespace aomgen
