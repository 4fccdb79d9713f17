// Runs tasks on a thread pool and on the calling thread.
#pragma once

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <exception>
#include <memory>
#include <mutex>
#include <new>
#include <utility>

namespace jaxfit {

// Returns at least `bytes` of 64-byte aligned scratch memory. Each thread keeps its memory from call to call, because
// the first use of fresh pages takes as long as a small image.
inline void* scratch(size_t bytes) {
  constexpr std::align_val_t kAlignment{64};
  struct Free {
    void operator()(void* p) const { ::operator delete(p, kAlignment); }
  };
  thread_local std::unique_ptr<void, Free> memory;
  thread_local size_t held = 0;
  if (held < bytes) {
    memory.reset();
    held = 0;
    memory.reset(::operator new(bytes, kAlignment));
    held = bytes;
  }
  return memory.get();
}

// Calls task(i) once for each i in [0, count). If tasks throw, rethrows the first exception on the calling thread and
// skips the tasks that have not started.
//
// The calling thread and the threads of the pool claim tasks one by one. The calling thread waits for claimed tasks
// only, so a busy pool slows the work down but cannot block it. A pool thread that starts late finds no task to claim
// and touches only the shared state, which it owns jointly. For the same reason a failure to schedule is harmless: the
// calling thread does the work.
template <typename Pool, typename Task>
void for_each_task(Pool& pool, int64_t count, Task task) {
  struct State {
    explicit State(int64_t count, Task task) : count(count), task(std::move(task)) {}
    const int64_t count;
    const Task task;
    std::atomic<int64_t> next{0};
    std::atomic<bool> failed{false};
    std::mutex mutex;  // guards `done` and `error`
    std::condition_variable finished;
    int64_t done = 0;
    std::exception_ptr error;

    void work() noexcept {
      int64_t claimed = 0;
      for (int64_t i; (i = next.fetch_add(1)) < count; ++claimed) {
        if (failed) continue;
        try {
          task(i);
        } catch (...) {
          std::lock_guard<std::mutex> lock(mutex);
          if (!error) error = std::current_exception();
          failed = true;
        }
      }
      if (!claimed) return;
      std::lock_guard<std::mutex> lock(mutex);
      done += claimed;
      if (done == count) finished.notify_all();
    }
  };
  auto state = std::make_shared<State>(count, std::move(task));
  const int64_t helpers = std::min<int64_t>(pool.num_threads(), count) - 1;
  try {
    for (int64_t i = 0; i < helpers; ++i) pool.Schedule([state] { state->work(); });
  } catch (...) {  // no memory or no thread for a helper
  }
  state->work();
  std::unique_lock<std::mutex> lock(state->mutex);
  state->finished.wait(lock, [&] { return state->done == state->count; });
  if (state->error) std::rethrow_exception(std::exchange(state->error, nullptr));
}

}  // namespace jaxfit
