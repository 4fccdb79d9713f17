// The renderer: the nearest face, the mask and interpolated attributes at the pixels of some rows of one image.
#pragma once

#include <cstddef>
#include <cstdint>

#include "mesh.h"

namespace jaxfit {

constexpr int64_t kMaxSamples = 8;

struct Frame {
  int64_t width, height;  // px, 1 to kMaxSize
  int64_t samples;        // number along the side of a pixel, 1 to kMaxSamples
};

struct Rows {
  int64_t first, end;  // pixel rows [first, end)
};

struct Run {
  int32_t first, end;  // pixels [first, end), counted column by column
};

// The entry points of one instruction set. Results are row-major and point to the first pixel of the image. Only the
// given rows are written. Rows do not depend on each other. `memory` is 64-byte aligned and has `workspace` bytes.
// `overlap` needs the bytes of no rows.
struct Renderer {
  size_t (*workspace)(const Mesh&, Frame, Rows);
  // Writes face (H, W), barycentric (H, W, 3) and depth (H, W). One sample per pixel.
  void (*fragments)(const Mesh&, Frame, Rows, void* memory, int32_t* face, float* barycentric, float* depth);
  // Writes 1 at the pixels that the mesh covers, 0 or nothing elsewhere. One sample per pixel.
  void (*mask)(const Mesh&, Frame, Rows, void* memory, uint8_t* mask);
  // Writes the tight box (x, y, width, height; 0 for an empty mask) and the number of pixels of the mask in the whole
  // image, and the number of pixels that each run shares with the mask. One sample per pixel.
  void (*overlap)(const Mesh&, Frame, void* memory, const Run* runs, int64_t num_runs, int32_t* box, int32_t* area,
                  int32_t* shared);
  // Reads attributes (V, C). Writes values (H, W, C), coverage (H, W) and face (H, W).
  void (*interpolate)(const Mesh&, Frame, Rows, void* memory, const float* attributes, int64_t channels,
                      float* values, float* coverage, int32_t* face);
  // Blends colours (V, 3) into image (H, W, 3). Only covered pixels are written.
  void (*draw)(const Mesh&, Frame, Rows, void* memory, const float* colours, uint8_t* image);
};

}  // namespace jaxfit
