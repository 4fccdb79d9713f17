// The choice of one of the compiled instruction sets.
#pragma once

#include <string>
#include <vector>

#include "silhouette.h"
#include "zbuffer.h"

namespace jaxfit {

// Returns the compiled sets that this processor can run, best first. "baseline" is always the last.
std::vector<std::string> available_isas();

// Returns the set in use. Initially it is the best available set.
std::string current_isa();

// Chooses the set to use; "auto" is the best set. Throws std::invalid_argument if the set is not available.
void choose_isa(const std::string& name);

const Kernels& current_kernels(Edge edge);
const Renderer& current_renderer();

}  // namespace jaxfit
