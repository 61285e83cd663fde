#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include <cmath>
#include <optional>
#include <stdexcept>
#include <vector>

#include "adam.hpp"
#include "light.hpp"

namespace nb = nanobind;
using namespace nb::literals;
using Floats = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using Const = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;

namespace {

void need(bool holds, const char *what) {
  if (!holds) throw std::invalid_argument(what);
}

nb::tuple tfs(Const image, Const texture, Const weight, Const gray, int domain, Floats grad) {
  auto pixels = static_cast<int64_t>(texture.size());
  need(image.size() == 3 * texture.size() && weight.size() == texture.size() && grad.size() == image.size(),
       "tfs: image and grad are [P,3], texture and weight [P]");
  need(gray.size() == 4 && domain >= 0 && domain <= 2, "tfs: gray is [4], domain 0..2");
  double value, by_gray[4];
  {
    nb::gil_scoped_release release;
    value = DISPATCH(tfs, image.data(), texture.data(), weight.data(), gray.data(), pixels,
                     static_cast<spikerig::Domain>(domain), grad.data(), by_gray);
  }
  return nb::make_tuple(value, nb::make_tuple(by_gray[0], by_gray[1], by_gray[2], by_gray[3]));
}

std::vector<const float *> starts(const std::vector<Const> &images, size_t count) {
  need(!images.empty(), "average: at least one image");
  std::vector<const float *> at;
  for (const Const &image : images) {
    need(image.size() == count, "average: all images have one size");
    at.push_back(image.data());
  }
  return at;
}

void decode(Const code, Floats light) {
  need(code.size() == light.size(), "decode: code and light have one size");
  nb::gil_scoped_release release;
  DISPATCH(decode, code.data(), static_cast<int64_t>(code.size()), light.data());
}

void average(const std::vector<Const> &images, std::optional<Const> base, int n, Floats out, Floats light) {
  need(light.size() == out.size() && (!base || base->size() == out.size()), "average: base, out and light have one size");
  need(n >= static_cast<int>(images.size()), "average: n counts the images too");
  auto at = starts(images, out.size());
  nb::gil_scoped_release release;
  DISPATCH(average, at.data(), static_cast<int>(at.size()), base ? base->data() : nullptr, n,
           static_cast<int64_t>(out.size()), out.data(), light.data());
}

void average_back(const std::vector<Const> &images, int n, Const out, Const light, Const grad,
                  const std::vector<Floats> &to) {
  need(light.size() == out.size() && grad.size() == out.size() && to.size() == images.size(),
       "average_back: out, light and grad have one size, one gradient an image");
  auto at = starts(images, out.size());
  std::vector<float *> into;
  for (const Floats &g : to) {
    need(g.size() == out.size(), "average_back: gradients have the images' size");
    into.push_back(g.data());
  }
  nb::gil_scoped_release release;
  DISPATCH(average_back, at.data(), static_cast<int>(at.size()), n, static_cast<int64_t>(out.size()), out.data(),
           light.data(), grad.data(), into.data());
}

void adam(Floats param, Const grad, Floats mean, Floats square, int64_t columns, int64_t head, int64_t count,
          double rate_head, double rate_rest, double beta1, double beta2, double eps) {
  auto size = static_cast<int64_t>(param.size());
  need(grad.size() == param.size() && mean.size() == param.size() && square.size() == param.size(),
       "adam: param, grad, mean and square have one size");
  need(columns >= 1 && size % columns == 0 && head >= 0 && count >= 1, "adam: size = rows x columns, count from 1");
  double warm = 1.0 - std::pow(beta1, static_cast<double>(count));
  spikerig::AdamStep step{static_cast<float>(beta1),
                          static_cast<float>(beta2),
                          static_cast<float>(eps),
                          static_cast<float>(rate_head / warm),
                          static_cast<float>(rate_rest / warm),
                          static_cast<float>(1.0 / std::sqrt(1.0 - std::pow(beta2, static_cast<double>(count))))};
  nb::gil_scoped_release release;
  DISPATCH(adam, param.data(), grad.data(), mean.data(), square.data(), size / columns, columns, head, step);
}

}  // namespace

void bind_light(nb::module_ &m) {
  m.def("tfs", &tfs, "image"_a, "texture"_a, "weight"_a, "gray"_a, "domain"_a, "grad"_a,
        "The TfS term and its gradients; train.losses.tfs_loss checks and wraps it.");
  m.def("decode", &decode, "code"_a, "light"_a, "Linear light of sRGB codes.");
  m.def("average", &average, "images"_a, "base"_a.none(), "n"_a, "out"_a, "light"_a,
        "Mean in linear light of sRGB-coded images and a sum of others' light, coded.");
  m.def("average_back", &average_back, "images"_a, "n"_a, "out"_a, "light"_a, "grad"_a, "to"_a,
        "Gradient of `average`.");
  m.def("adam", &adam, "param"_a, "grad"_a, "mean"_a, "square"_a, "columns"_a, "head"_a, "count"_a, "rate_head"_a,
        "rate_rest"_a, "beta1"_a, "beta2"_a, "eps"_a, "One step of Adam, in place; train.adam.update wraps it.");
}
