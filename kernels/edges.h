// The distinct edges of the faces of a mesh. Part of ffi.cc.
#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "mesh.h"

namespace jaxfit {
namespace {

// An edge is stored at its lower vertex, in a list. A vertex has few edges, so the lists are short.
class EdgeTable {
 public:
  EdgeTable(const int32_t* faces, int64_t num_faces, int64_t num_vertices) : of_face_(3 * num_faces) {
    std::vector<int32_t> first(num_vertices, -1), next;
    for (int64_t i = 0; i < 3 * num_faces; ++i) {
      const int32_t from = faces[i], to = faces[i / 3 * 3 + (i + 1) % 3];
      const int32_t low = std::min(from, to), high = std::max(from, to);
      int32_t edge = first[low];
      while (edge >= 0 && ends_[2 * edge + 1] != high) edge = next[edge];
      if (edge < 0) {
        edge = static_cast<int32_t>(next.size());
        ends_.push_back(low), ends_.push_back(high);
        next.push_back(first[low]);
        first[low] = edge;
      }
      of_face_[i] = 2 * edge + (from > to);
    }
  }

  Edges view() const { return {ends_.data(), of_face_.data(), static_cast<int64_t>(ends_.size() / 2)}; }

 private:
  std::vector<int32_t> ends_, of_face_;
};

}  // namespace
}  // namespace jaxfit
