// The renderer's Python functions.
#pragma once

#include <nanobind/nanobind.h>

namespace jaxfit {

// They fill arrays that the caller has made and checked; jaxfit/raster/zbuffer/operator.py is the only one.
void add_renderer(nanobind::module_& m);

}  // namespace jaxfit
