// Python's way to the event kernels. Shapes that the C++ side relies on are checked here once more; the messages for
// people are in dataset/kernels.py.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cmath>
#include <stdexcept>

#include "events.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

template <class T, int N>
using In = nb::ndarray<const T, nb::ndim<N>, nb::c_contig, nb::device::cpu>;
template <class T>
using Out = nb::ndarray<T, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

void need(bool fine, const char *what) {
  if (!fine) throw std::invalid_argument(what);
}

spikerig::EventLight light_of(const In<float, 2> &rows, const In<double, 1> &at, bool hold) {
  const auto knots = static_cast<int64_t>(at.shape(0));
  need(knots >= 1 && static_cast<int64_t>(rows.shape(0)) >= std::max<int64_t>(1, hold ? knots - 1 : knots),
       "too few knots or light rows");
  for (int64_t k = 1; k < knots; ++k) need(at.data()[k] > at.data()[k - 1], "knots must increase");
  return {rows.data(), at.data(), knots - 1, static_cast<int64_t>(rows.shape(1)), hold};
}

spikerig::EventSensor sensor_of(const spikerig::EventLight &light, const In<double, 1> &up, const In<double, 1> &down,
                                double eps, double refractory, double tau, int64_t end, const In<int64_t, 1> &start,
                                const In<double, 1> &at, const In<int8_t, 1> &sign) {
  const auto pixels = static_cast<size_t>(light.pixels);
  need(up.shape(0) == pixels && down.shape(0) == pixels && start.shape(0) == pixels + 1, "one value a pixel");
  for (size_t p = 0; p < pixels; ++p)
    need(up.data()[p] > 1 + 1e-9 && down.data()[p] > 0 && down.data()[p] < 1 - 1e-9, "factors must differ from 1");
  need(eps > 0 && refractory >= 0 && refractory == std::floor(refractory) && tau >= 0, "eps, refractory or tau");
  const auto noises = static_cast<int64_t>(at.shape(0));
  need(static_cast<int64_t>(sign.shape(0)) == noises && start.data()[0] == 0 && start.data()[pixels] == noises,
       "noise must be that of the pixels");
  for (size_t p = 0; p < pixels; ++p) need(start.data()[p] <= start.data()[p + 1], "noise starts must not decrease");
  return {up.data(),  down.data(), eps, refractory, tau, noises ? start.data() : nullptr,
          at.data(), sign.data(), end};
}

int64_t count_events(In<float, 2> rows, In<double, 1> knots, bool hold, In<double, 1> up, In<double, 1> down, double eps,
                     double refractory, double tau, int64_t end, In<int64_t, 1> noise_start, In<double, 1> noise_at,
                     In<int8_t, 1> noise_sign, int64_t most, Out<int64_t> counts) {
  const auto light = light_of(rows, knots, hold);
  const auto sensor = sensor_of(light, up, down, eps, refractory, tau, end, noise_start, noise_at, noise_sign);
  need(static_cast<int64_t>(counts.shape(0)) == light.pixels, "counts must be [pixels]");
  nb::gil_scoped_release release;
  return DISPATCH(count_events, light, sensor, most, counts.data());
}

void events(In<float, 2> rows, In<double, 1> knots, bool hold, In<double, 1> up, In<double, 1> down, double eps,
            double refractory, double tau, int64_t end, In<int64_t, 1> noise_start, In<double, 1> noise_at,
            In<int8_t, 1> noise_sign, In<int64_t, 1> start, Out<int64_t> t, Out<int8_t> sign) {
  const auto light = light_of(rows, knots, hold);
  const auto sensor = sensor_of(light, up, down, eps, refractory, tau, end, noise_start, noise_at, noise_sign);
  need(static_cast<int64_t>(start.shape(0)) == light.pixels + 1 &&
           start.data()[light.pixels] == static_cast<int64_t>(t.shape(0)) && t.shape(0) == sign.shape(0),
       "start, t and sign must be those that count_events asks for");
  nb::gil_scoped_release release;
  DISPATCH(events, light, sensor, start.data(), t.data(), sign.data());
}

}  // namespace

void bind_events(nb::module_ &m) {
  m.def("count_events", &count_events, "rows"_a, "knots"_a, "hold"_a, "up"_a, "down"_a, "eps"_a, "refractory"_a, "tau"_a,
        "end"_a, "noise_start"_a, "noise_at"_a, "noise_sign"_a, "most"_a, "counts"_a,
        "Events a pixel; dataset.kernels.events checks and wraps it.");
  m.def("events", &events, "rows"_a, "knots"_a, "hold"_a, "up"_a, "down"_a, "eps"_a, "refractory"_a, "tau"_a, "end"_a,
        "noise_start"_a, "noise_at"_a, "noise_sign"_a, "start"_a, "t"_a, "sign"_a, "The events counted.");
}
