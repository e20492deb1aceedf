// Threads that sleep until there is work. No spinning: on a busy machine a spinning barrier costs
// whole time slices.
#pragma once

#include <cstdint>

namespace aomgen {

int processor_count();

using Task = void (*)(void* context, int64_t item, int worker);

// Calls task(context, item, worker) once for every item in 0..count-1, on at most `threads` threads
// of which the caller is one; worker < threads tells them apart. Items are handed out in order, in
// groups of `grain`. Runs on the caller alone while another thread uses the pool. If a call throws, the
// items not yet begun are given up, and the first exception is thrown again once no thread is at work.
void parallel_for(int threads, int64_t count, int64_t grain, Task task, void* context);

template <class Function>
void parallel(int threads, int64_t count, int64_t grain, Function&& function) {
  parallel_for(
      threads, count, grain,
      [](void* f, int64_t item, int worker) { (*static_cast<Function*>(f))(item, worker); },
      const_cast<void*>(static_cast<const void*>(&function)));
}

}  // namespace aomgen
