// The Python module: XLA's handlers as capsules, the renderer, and the choice of the instruction set.
#include <nanobind/nanobind.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "ffi.h"
#include "instruction_set.h"
#include "render.h"

namespace nb = nanobind;

NB_MODULE(_kernels, m) {
  m.def("handlers", [] {
    nb::dict handlers;
    const auto add = [&](const char* name, XLA_FFI_Handler* handler) {
      handlers[name] = nb::capsule(reinterpret_cast<void*>(handler));
    };
    add("jaxfit_silhouette", jaxfit::silhouette_handler);
    add("jaxfit_silhouette_gradient", jaxfit::silhouette_gradient_handler);
    add("jaxfit_mask_loss", jaxfit::mask_loss_handler);
    add("jaxfit_mask_loss_and_gradient", jaxfit::mask_loss_and_gradient_handler);
    add("jaxfit_mask_loss_gradient_and_block", jaxfit::mask_loss_gradient_and_block_handler);
    return handlers;
  });
  jaxfit::add_renderer(m);
  m.def("available_isas", &jaxfit::available_isas);
  m.def("current_isa", &jaxfit::current_isa);
  m.def("choose_isa", &jaxfit::choose_isa, nb::arg("name"));
}
