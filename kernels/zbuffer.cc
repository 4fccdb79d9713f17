// The z-buffer. This file is compiled once for each instruction set.
//
// The code repeats the operations of jaxfit/raster/zbuffer_reference.py in double precision, so that both find the same
// face at every sample. This requires -ffp-contract=off. First, every face writes its nearness (1/depth) and its number
// to the samples where it is the nearest face so far. Then the weights of the nearest face are computed again at every
// sample. Only tiles of columns that a face reaches are cleared and read, so the time depends on the covered area.
// Masks need no depths: coverage.h draws them.
#include "compiled.h"
#include "coverage.h"
#include "strip.h"

namespace jaxfit {
namespace {

// Calls visit(row, column) for every pixel of the touched tiles and empty(row, column) for every other pixel.
template <typename Visit, typename Empty>
inline void for_each_pixel(const Strip& s, Visit visit, Empty empty) {
  for (int64_t row = s.rows.first; row < s.rows.end; ++row)
    for (int64_t tile = 0; tile < s.tiles; ++tile) {
      const int64_t end = (tile + 1) * kTile < s.frame.width ? (tile + 1) * kTile : s.frame.width;
      if (s.touched[tile])
        for (int64_t column = tile * kTile; column < end; ++column) visit(row, column);
      else
        for (int64_t column = tile * kTile; column < end; ++column) empty(row, column);
    }
}

size_t workspace(const Mesh& mesh, Frame frame, Rows rows) {
  const size_t strip = strip_workspace(mesh, frame, rows), patch = patch_workspace(mesh);
  return strip > patch ? strip : patch;
}

void fragments(const Mesh& mesh, Frame frame, Rows rows, void* memory, int32_t* face, float* barycentric,
               float* depth) {
  const Strip s = rasterise(mesh, frame, rows, memory);
  const auto empty = [&](int64_t row, int64_t column) {
    const int64_t at = row * frame.width + column;
    face[at] = -1, depth[at] = __builtin_inff();
    for (int i = 0; i < 3; ++i) barycentric[3 * at + i] = 0;
  };
  const auto visit = [&](int64_t row, int64_t column) {
    const int32_t number = s.face[(row - rows.first) * s.columns + column];
    if (number < 0) return empty(row, column);
    const int64_t at = row * frame.width + column;
    const Face& f = s.faces[number];
    double weights[3];
    face[at] = f.index;
    depth[at] = static_cast<float>(
        1 / weigh(f, static_cast<double>(column) + 0.5, static_cast<double>(row) + 0.5, weights));
    for (int i = 0; i < 3; ++i) barycentric[3 * at + i] = static_cast<float>(weights[i]);
  };
  for_each_pixel(s, visit, empty);
}

void mask(const Mesh& mesh, Frame frame, Rows rows, void* memory, uint8_t* mask) {
  for_each_patch(mesh, kX, frame.width, rows.first, rows.end, memory, [&](const Patch& p) {
    for (int64_t row = p.first; row < p.end; ++row)
      __builtin_memcpy(mask + row * frame.width + p.low, p.line(row), static_cast<size_t>(p.high - p.low));
  });
}

int32_t sum(const uint8_t* bytes, int64_t first, int64_t end) {
  int32_t total = 0;
  for (int64_t i = first; i < end; ++i) total += bytes[i];
  return total;
}

// Returns the number of covered pixels of a run. The lines of the patch are columns.
int32_t sum(const Patch& p, int64_t height, Run run) {
  int32_t total = 0;
  const int64_t start = run.first / height;
  for (int64_t column = start > p.first ? start : p.first; column < p.end && column * height < run.end; ++column) {
    const int64_t top = run.first - column * height, bottom = run.end - column * height;
    total += sum(p.line(column), (top > p.low ? top : p.low) - p.low, (bottom < p.high ? bottom : p.high) - p.low);
  }
  return total;
}

void overlap(const Mesh& mesh, Frame frame, void* memory, const Run* runs, int64_t num_runs, int32_t* box,
             int32_t* area, int32_t* shared) {
  int64_t left = frame.width, right = 0, top = frame.height, bottom = 0;
  *area = 0;
  for (int64_t i = 0; i < num_runs; ++i) shared[i] = 0;
  for_each_patch(mesh, kY, frame.height, 0, frame.width, memory, [&](const Patch& p) {
    for (int64_t i = 0; i < num_runs; ++i) shared[i] += sum(p, frame.height, runs[i]);
    for (int64_t column = p.first; column < p.end; ++column) {
      const uint8_t* line = p.line(column);
      const int32_t covered = sum(line, 0, p.high - p.low);
      if (!covered) continue;
      *area += covered;
      left = column < left ? column : left, right = column + 1;
      // only rows beyond the box so far can enlarge it
      for (int64_t row = p.low; row < top && row < p.high; ++row)
        if (line[row - p.low]) top = row;
      for (int64_t row = p.high; row > bottom && row > p.low; --row)
        if (line[row - 1 - p.low]) bottom = row;
    }
  });
  if (!*area) left = right = top = bottom = 0;
  box[0] = static_cast<int32_t>(left), box[1] = static_cast<int32_t>(top);
  box[2] = static_cast<int32_t>(right - left), box[3] = static_cast<int32_t>(bottom - top);
}

// The part of one face in a pixel: its weights, summed over the samples where the face is visible.
struct Share {
  const int32_t* corner;
  double weights[3];
};

struct Pixel {
  Share shares[kMaxSamples * kMaxSamples];
  int count;     // number of shares
  int covered;   // number of covered samples
  int32_t face;  // the face at the nearest sample, or -1
};

void gather(const Mesh& mesh, const Strip& s, int64_t row, int64_t column, Pixel& pixel) {
  const int64_t n = s.frame.samples;
  float nearest = -1;
  int32_t last = -1;
  double sum0 = 0, sum1 = 0, sum2 = 0;  // the weights of the share of `last`, in registers
  const auto close = [&] {
    if (last >= 0) pixel.shares[pixel.count++] = {mesh.faces + 3 * s.faces[last].index, {sum0, sum1, sum2}};
  };
  pixel.count = pixel.covered = 0, pixel.face = -1;
  for (int64_t line = 0; line < n; ++line) {
    const int64_t at = ((row - s.rows.first) * n + line) * s.columns + column * n;
    for (int64_t i = 0; i < n; ++i) {
      const int32_t number = s.face[at + i];
      if (number < 0) continue;
      const Face& f = s.faces[number];
      double weights[3];
      weigh(f, static_cast<double>(column * n + i) + 0.5, static_cast<double>(row * n + line) + 0.5, weights);
      if (number != last) close(), last = number, sum0 = sum1 = sum2 = 0;
      sum0 += weights[0], sum1 += weights[1], sum2 += weights[2];
      ++pixel.covered;
      if (s.near[at + i] > nearest) nearest = s.near[at + i], pixel.face = f.index;
    }
  }
  close();
}

// Returns Σ weight · attribute over the samples of a pixel.
double total(const Pixel& pixel, const float* attributes, int64_t channels, int64_t channel) {
  double sum = 0;
  for (int i = 0; i < pixel.count; ++i)
    for (int c = 0; c < 3; ++c)
      sum += pixel.shares[i].weights[c] *
             static_cast<double>(attributes[pixel.shares[i].corner[c] * channels + channel]);
  return sum;
}

void interpolate(const Mesh& mesh, Frame frame, Rows rows, void* memory, const float* attributes, int64_t channels,
                 float* values, float* coverage, int32_t* face) {
  const Strip s = rasterise(mesh, frame, rows, memory);
  const double samples = static_cast<double>(frame.samples * frame.samples);
  const auto empty = [&](int64_t row, int64_t column) {
    const int64_t at = row * frame.width + column;
    face[at] = -1, coverage[at] = 0;
    for (int64_t c = 0; c < channels; ++c) values[at * channels + c] = 0;
  };
  Pixel pixel;
  const auto visit = [&](int64_t row, int64_t column) {
    gather(mesh, s, row, column, pixel);
    if (!pixel.covered) return empty(row, column);
    const int64_t at = row * frame.width + column;
    face[at] = pixel.face, coverage[at] = static_cast<float>(pixel.covered / samples);
    for (int64_t c = 0; c < channels; ++c)
      values[at * channels + c] = static_cast<float>(total(pixel, attributes, channels, c) / samples);
  };
  for_each_pixel(s, visit, empty);
}

void draw(const Mesh& mesh, Frame frame, Rows rows, void* memory, const float* colours, uint8_t* image) {
  const Strip s = rasterise(mesh, frame, rows, memory);
  const double samples = static_cast<double>(frame.samples * frame.samples);
  Pixel pixel;
  const auto visit = [&](int64_t row, int64_t column) {
    gather(mesh, s, row, column, pixel);
    if (!pixel.covered) return;
    uint8_t* at = image + 3 * (row * frame.width + column);
    for (int c = 0; c < 3; ++c) {
      // Rounding to float first removes the rounding errors of the sums, so that exact halves always round up.
      const float mixed = static_cast<float>((1 - pixel.covered / samples) * at[c] +
                                             255 * (total(pixel, colours, 3, c) / samples));
      at[c] = static_cast<uint8_t>(mixed > 0 ? mixed < 255 ? mixed + 0.5f : 255.f : 0.f);
    }
  };
  for_each_pixel(s, visit, [](int64_t, int64_t) {});
}

}  // namespace

template <>
const Renderer Compiled<kIsa>::renderer = {workspace, fragments, mask, overlap, interpolate, draw};

}  // namespace jaxfit
