// Python's way to the spike kernels. Shapes that the C++ side relies on are checked here once more (a wrong one
// would be a crash); the messages for people are in dataset/kernels.py.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>

#include <stdexcept>

#include "spike_kernels.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

template <class T, class Shape>
using In = nb::ndarray<const T, Shape, nb::c_contig, nb::device::cpu>;
template <class T, class Shape>
using Out = nb::ndarray<T, Shape, nb::c_contig, nb::device::cpu>;
using Bits = In<uint8_t, nb::ndim<3>>;

void need(bool fine, const char *what) {
  if (!fine) throw std::invalid_argument(what);
}

spikerig::Packed packed(const Bits &bits, int64_t width) {
  const spikerig::Packed s{bits.data(), static_cast<int64_t>(bits.shape(0)), static_cast<int64_t>(bits.shape(1)),
                           width};
  need(width >= 1 && static_cast<int64_t>(bits.shape(2)) == s.row(), "bits must be uint8[T,H,ceil(W/8)]");
  return s;
}

template <class Array>
bool image(const Array &a, const spikerig::Packed &s) {
  return static_cast<int64_t>(a.shape(0)) == s.height && static_cast<int64_t>(a.shape(1)) == s.width;
}

template <class Array>
bool movie(const Array &a, const spikerig::Packed &s) {
  return static_cast<int64_t>(a.shape(0)) == s.ticks && static_cast<int64_t>(a.shape(1)) == s.height &&
         static_cast<int64_t>(a.shape(2)) == s.width;
}

void unpack(Bits bits, int64_t width, Out<uint8_t, nb::ndim<3>> out) {
  const auto s = packed(bits, width);
  need(movie(out, s), "out must be uint8[T,H,W]");
  nb::gil_scoped_release release;
  DISPATCH(unpack, s, out.data());
}

void count(Bits bits, int64_t width, int64_t t0, int64_t t1, Out<uint32_t, nb::ndim<2>> out) {
  const auto s = packed(bits, width);
  need(0 <= t0 && t0 <= t1 && t1 <= s.ticks && t1 - t0 <= UINT32_MAX, "the window must lie in the stream");
  need(image(out, s), "out must be uint32[H,W]");
  nb::gil_scoped_release release;
  DISPATCH(count, s, t0, t1, out.data());
}

void tfi_at(Bits bits, int64_t width, int64_t tick, int before, int after, Out<int32_t, nb::ndim<2>> previous,
            Out<int32_t, nb::ndim<2>> next) {
  const auto s = packed(bits, width);
  need(0 <= tick && tick <= s.ticks && s.ticks <= INT32_MAX, "the tick must lie in the stream");
  need(before >= 1 && after >= 1, "ranks start at 1");
  need(image(previous, s) && image(next, s), "previous and next must be int32[H,W]");
  nb::gil_scoped_release release;
  DISPATCH(tfi_at, s, tick, before, after, previous.data(), next.data());
}

void tfi_all(Bits bits, int64_t width, Out<uint16_t, nb::ndim<3>> out) {
  const auto s = packed(bits, width);
  need(movie(out, s), "out must be uint16[T,H,W]");
  nb::gil_scoped_release release;
  DISPATCH(tfi_all, s, out.data());
}

using Rows = In<float, nb::ndim<3>>;
using Knots = In<int64_t, nb::ndim<1>>;
using Charge = Out<int64_t, nb::ndim<2>>;
using Fired = Out<uint8_t, nb::ndim<3>>;
using Image = Out<double, nb::ndim<2>>;
using Key = std::array<uint32_t, 2>;

spikerig::Light light_of(const Rows &rows, const Knots &knots, bool hold, int64_t begin, const Charge &charge,
                         const Fired &bits, const Image &lost) {
  const auto count = static_cast<int64_t>(knots.shape(0));
  need(count >= 1, "at least one knot");
  const spikerig::Light light{rows.data(), knots.data(), count - 1, static_cast<int64_t>(rows.shape(1)),
                              static_cast<int64_t>(rows.shape(2)), hold, begin,
                              begin + static_cast<int64_t>(bits.shape(0))};
  need(static_cast<int64_t>(rows.shape(0)) >= (hold ? count - 1 : count), "too few light rows");
  for (int64_t k = 1; k < count; ++k) need(knots.data()[k] >= knots.data()[k - 1], "knots must not decrease");
  const spikerig::Packed s{bits.data(), static_cast<int64_t>(bits.shape(0)), light.height, light.width};
  need(light.width >= 1 && static_cast<int64_t>(bits.shape(1)) == s.height &&
           static_cast<int64_t>(bits.shape(2)) == s.row(),
       "bits must be uint8[T,H,ceil(W/8)]");
  need(knots.data()[0] <= light.begin && light.end <= knots.data()[count - 1], "ticks must lie within the knots");
  need(image(charge, s) && image(lost, s), "charge and clipped must be [H,W]");
  return light;
}

void fire(Rows rows, Knots knots, bool hold, int64_t begin, bool carry, Charge charge, Fired bits, Image clipped) {
  const auto light = light_of(rows, knots, hold, begin, charge, bits, clipped);
  nb::gil_scoped_release release;
  DISPATCH(fire, light, carry, charge.data(), bits.data(), clipped.data());
}

void fire_noisy(Rows rows, Knots knots, bool hold, int64_t begin, int64_t first_tick, bool carry,
                std::optional<In<float, nb::ndim<2>>> electrons, Key shot_key, float sd, Key comparator_key,
                uint32_t loss, std::optional<In<uint8_t, nb::ndim<2>>> before, Charge charge, Fired bits, Image lost) {
  const auto light = light_of(rows, knots, hold, begin, charge, bits, lost);
  need(!electrons || (electrons->shape(0) == rows.shape(1) && electrons->shape(1) == rows.shape(2)),
       "electrons must be [H,W]");
  need(!before || (before->shape(0) == bits.shape(1) && before->shape(1) == bits.shape(2)),
       "before must be uint8[H,ceil(W/8)]");
  need(light.height * light.width <= UINT32_MAX, "too many pixels");
  const spikerig::Noise noise{electrons ? electrons->data() : nullptr, {shot_key[0], shot_key[1]}, sd,
                              {comparator_key[0], comparator_key[1]}, loss};
  nb::gil_scoped_release release;
  DISPATCH(fire_noisy, light, first_tick, noise, carry, charge.data(), before ? before->data() : nullptr, bits.data(),
           lost.data());
}

}  // namespace

void bind_spikes(nb::module_ &m) {
  m.def("unpack", &unpack, "bits"_a, "width"_a, "out"_a);
  m.def("count", &count, "bits"_a, "width"_a, "t0"_a, "t1"_a, "out"_a);
  m.def("tfi_at", &tfi_at, "bits"_a, "width"_a, "tick"_a, "before"_a, "after"_a, "previous"_a, "next"_a);
  m.def("tfi_all", &tfi_all, "bits"_a, "width"_a, "out"_a);
  m.def("fire", &fire, "light"_a, "knots"_a, "hold"_a, "begin"_a, "carry"_a, "charge"_a, "bits"_a, "clipped"_a);
  m.def("fire_noisy", &fire_noisy, "light"_a, "knots"_a, "hold"_a, "begin"_a, "first_tick"_a, "carry"_a,
        "electrons"_a.none(), "shot_key"_a, "sd"_a, "comparator_key"_a, "loss"_a, "before"_a.none(), "charge"_a,
        "bits"_a, "lost"_a);
}
