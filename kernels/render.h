// The renderer's Python functions.
#pragma once

#include <nanobind/nanobind.h>

namespace jaxfit {

// Adds the functions to the module. They fill arrays of the caller. Arguments that do not fit each other raise
// ValueError. jaxfit/raster/zbuffer.py is the only caller.
void add_renderer(nanobind::module_& m);

}  // namespace jaxfit
