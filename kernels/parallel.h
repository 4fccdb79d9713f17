// Runs many tasks on a thread pool and on the calling thread.
#pragma once

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <cstdlib>
#include <memory>
#include <mutex>
#include <new>
#include <utility>

namespace jaxfit {

// Scratch that each thread keeps from call to call, since fresh pages cost as much as a small image.
inline void* scratch(size_t bytes) {
  struct Free {
    void operator()(void* p) const { std::free(p); }
  };
  thread_local std::unique_ptr<void, Free> memory;
  thread_local size_t held = 0;
  if (held < bytes) {
    memory.reset();
    held = 0;
    const size_t rounded = (bytes + 63) / 64 * 64;
    memory.reset(std::aligned_alloc(64, rounded));
    if (!memory) throw std::bad_alloc();
    held = rounded;
  }
  return memory.get();
}

// Calls task(i) for each i in [0, count), each on one thread; returns false if one threw.
//
// Threads claim tasks one by one, the caller among them, and the caller waits for claimed tasks only. So a pool
// whose threads are all busy elsewhere slows this down but cannot block it; a helper that starts late finds nothing
// left to claim, and touches only the state it shares ownership of.
template <typename Pool, typename Task>
bool for_each_task(Pool& pool, int64_t count, Task task) {
  struct State {
    explicit State(int64_t count, Task task) : count(count), task(std::move(task)) {}
    const int64_t count;
    const Task task;
    std::atomic<int64_t> next{0};
    std::atomic<bool> failed{false};
    std::mutex mutex;
    std::condition_variable finished;
    int64_t done = 0;

    void work() {
      int64_t mine = 0;
      for (int64_t i; (i = next.fetch_add(1)) < count; ++mine) try {
          task(i);
        } catch (...) {
          failed = true;
        }
      if (!mine) return;
      std::lock_guard<std::mutex> lock(mutex);
      done += mine;
      if (done == count) finished.notify_all();
    }
  };
  auto state = std::make_shared<State>(count, std::move(task));
  const int64_t helpers = std::min<int64_t>(pool.num_threads(), count) - 1;
  for (int64_t i = 0; i < helpers; ++i) pool.Schedule([state] { state->work(); });
  state->work();
  std::unique_lock<std::mutex> lock(state->mutex);
  state->finished.wait(lock, [&] { return state->done == state->count; });
  return !state->failed;
}

}  // namespace jaxfit
