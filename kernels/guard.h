// Keeps C++ exceptions out of XLA's C interface.
#pragma once

#include <cstdio>
#include <exception>
#include <new>
#include <stdexcept>

#include "xla/ffi/api/c_api.h"

namespace jaxfit {

// Makes an XLA error. The message is formatted on the stack, because memory may be exhausted.
inline XLA_FFI_Error* make_error(const XLA_FFI_Api* api, XLA_FFI_Error_Code code, const char* message) noexcept {
  char text[1024];
  std::snprintf(text, sizeof text, "jaxfit: %s", message);
  XLA_FFI_Error_Create_Args args{};
  args.struct_size = XLA_FFI_Error_Create_Args_STRUCT_SIZE;
  args.message = text;
  args.errc = code;
  return api->XLA_FFI_Error_Create(&args);
}

// Returns call(), or the XLA error that corresponds to the exception of call().
template <typename Call>
XLA_FFI_Error* call_guarded(const XLA_FFI_Api* api, Call call) noexcept {
  try {
    return call();
  } catch (const std::bad_alloc&) {
    return make_error(api, XLA_FFI_Error_Code_RESOURCE_EXHAUSTED, "out of memory");
  } catch (const std::invalid_argument& error) {
    return make_error(api, XLA_FFI_Error_Code_INVALID_ARGUMENT, error.what());
  } catch (const std::exception& error) {
    return make_error(api, XLA_FFI_Error_Code_INTERNAL, error.what());
  } catch (...) {
    return make_error(api, XLA_FFI_Error_Code_INTERNAL, "unknown C++ exception");
  }
}

}  // namespace jaxfit
