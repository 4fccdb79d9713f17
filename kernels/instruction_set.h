// Which of the compiled instruction sets runs.
#pragma once

#include <string>
#include <vector>

#include "silhouette.h"
#include "zbuffer.h"

namespace jaxfit {

// The sets that this build has and this processor can run, best first; "baseline" is always the last.
std::vector<std::string> available_isas();

// The set in use: the best available one, until chosen otherwise.
std::string current_isa();

// Throws std::invalid_argument for a set that is not available; "auto" is the best one.
void choose_isa(const std::string& name);

const Kernels& current_kernels();
const Renderer& current_renderer();

}  // namespace jaxfit
