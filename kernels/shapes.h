// Shapes in error messages.
#pragma once

#include <cstdint>
#include <string>

namespace jaxfit {

constexpr int64_t kAny = -1;  // an expected dimension that may have any size

template <typename Shape>
std::string text_of(const Shape& shape) {
  std::string text = "(";
  for (int64_t size : shape) {
    if (text.size() > 1) text += ", ";
    text += size == kAny ? "any" : std::to_string(size);
  }
  return text + ")";
}

}  // namespace jaxfit
