// Prints what kernels/parallel.h and kernels/guard.h make of exceptions; test_kernel_exceptions.py runs this program.
#include <cstdio>
#include <new>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#include "guard.h"
#include "parallel.h"

struct XLA_FFI_Error {};

namespace {

// A pool of three helper threads. With `broken`, the second helper cannot be started.
struct Pool {
  bool broken = false;
  std::vector<std::thread> started = {};
  int64_t num_threads() const { return 4; }
  template <typename Work>
  void Schedule(Work work) {
    if (broken && !started.empty()) throw std::bad_alloc();
    started.emplace_back(std::move(work));
  }
  ~Pool() {
    for (std::thread& thread : started) thread.join();
  }
};

// The message of the exception that a failing task of 1000 raises on the calling thread.
template <typename Fail>
std::string message_of(Fail fail) {
  Pool pool;
  try {
    jaxfit::for_each_task(pool, 1000, [fail](int64_t i) {
      std::this_thread::yield();
      if (i == 567) fail();
    });
  } catch (const std::exception& error) {
    return error.what();
  } catch (int number) {
    return "int " + std::to_string(number);
  }
  return "nothing";
}

// The XLA error that the exception of a handler becomes.
template <typename Fail>
std::string xla_error_of(Fail fail) {
  static std::string text;
  XLA_FFI_Api api{};
  api.XLA_FFI_Error_Create = [](XLA_FFI_Error_Create_Args* args) {
    static XLA_FFI_Error error;
    text = std::to_string(args->errc) + " " + args->message;
    return &error;
  };
  text = "nothing";
  jaxfit::call_guarded(&api, [&]() -> XLA_FFI_Error* {
    fail();
    return nullptr;
  });
  return text;
}

std::string sum_without_memory_for_helpers() {
  Pool pool{true};
  std::atomic<int64_t> sum{0};
  jaxfit::for_each_task(pool, 1000, [&sum](int64_t i) { sum += i; });
  return std::to_string(sum);
}

void print(const char* name, const std::string& text) { std::printf("%s: %s\n", name, text.c_str()); }

}  // namespace

int main() {
  print("task runtime_error", message_of([] { throw std::runtime_error("the task's own message"); }));
  print("task bad_alloc", message_of([] { throw std::bad_alloc(); }));
  print("task int", message_of([] { throw 7; }));
  print("task none", message_of([] {}));
  print("helpers", sum_without_memory_for_helpers());
  print("xla runtime_error", xla_error_of([] { throw std::runtime_error("the task's own message"); }));
  print("xla invalid_argument", xla_error_of([] { throw std::invalid_argument("faces: too few"); }));
  print("xla bad_alloc", xla_error_of([] { throw std::bad_alloc(); }));
  print("xla int", xla_error_of([] { throw 7; }));
  print("xla none", xla_error_of([] {}));
}
