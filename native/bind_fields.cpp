#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <stdexcept>

#include "hashgrid.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using In = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using Out = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using Levels = nb::ndarray<const int64_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

void expect(bool right, const char *what) {  // train/hashgrid.py has checked and explained; this guards memory
  if (!right) throw std::invalid_argument(what);
}

spikerig::GridPlan plan_of(Levels levels, In points, size_t table, size_t encoded) {
  expect(levels.shape(1) == 4 && levels.shape(0) >= 1 && levels.shape(0) <= spikerig::GRID_LEVELS, "levels");
  expect(points.ndim() == 2 && points.shape(1) == 3, "points");
  spikerig::GridPlan plan{};
  plan.levels = static_cast<int>(levels.shape(0));
  plan.points = points.data();
  plan.n = static_cast<int64_t>(points.shape(0));
  int64_t rows = 0;
  for (int l = 0; l < plan.levels; ++l) {
    const int64_t *from = levels.data() + 4 * l;  // cells, mask, first, rows
    const int64_t cells = from[0], side = cells + 1;
    expect(cells >= 1 && cells <= 1 << 20 && from[2] == rows && from[3] >= 1, "level");
    expect(from[1] < 0 ? cells < 1024 && from[3] >= side * side * side : from[3] == from[1] + 1, "level's rows");
    expect(from[1] < 0 || (from[3] & from[1]) == 0, "a hashed level has a power of two of rows");
    plan.level[l] = {static_cast<int32_t>(cells), static_cast<int32_t>(from[1]), from[2], from[3]};
    rows += from[3];
  }
  expect(table == static_cast<size_t>(rows) * spikerig::GRID_FEATURES, "table");
  expect(encoded == static_cast<size_t>(plan.n) * plan.levels * spikerig::GRID_FEATURES, "features");
  return plan;
}

void hash_encode(Levels levels, In points, In table, Out out) {
  const spikerig::GridPlan plan = plan_of(levels, points, table.size(), out.size());
  nb::gil_scoped_release release;
  DISPATCH(hash_encode, plan, table.data(), out.data());
}

void hash_encode_back(Levels levels, In points, In grad, Out table_grad) {
  const spikerig::GridPlan plan = plan_of(levels, points, table_grad.size(), grad.size());
  nb::gil_scoped_release release;
  DISPATCH(hash_encode_back, plan, grad.data(), table_grad.data());
}

}  // namespace

void bind_fields(nb::module_ &m) {
  m.def("hash_encode", &hash_encode, "levels"_a, "points"_a, "table"_a, "out"_a,
        "levels: int64[L,4] cells, mask (-1: dense), first row, rows; points in [0, 1].");
  m.def("hash_encode_back", &hash_encode_back, "levels"_a, "points"_a, "grad"_a, "table_grad"_a,
        "Gradient of the table, every row written, summed in the order of the points.");
}
