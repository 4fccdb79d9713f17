// The handlers that XLA calls. An error returns as an XLA error; no exception leaves a handler.
#pragma once

#include "xla/ffi/api/ffi.h"

namespace jaxfit {

XLA_FFI_Error* silhouette_handler(XLA_FFI_CallFrame* frame);
XLA_FFI_Error* silhouette_gradient_handler(XLA_FFI_CallFrame* frame);
XLA_FFI_Error* mask_loss_handler(XLA_FFI_CallFrame* frame);
XLA_FFI_Error* mask_loss_and_gradient_handler(XLA_FFI_CallFrame* frame);
XLA_FFI_Error* mask_loss_gradient_and_block_handler(XLA_FFI_CallFrame* frame);

}  // namespace jaxfit
