#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <memory>
#include <mutex>
#include <stdexcept>
#include <vector>

#include "train_kernels.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using In = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using Out = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using InDouble = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using OutDouble = nb::ndarray<double, nb::c_contig, nb::device::cpu>;
using Mask = nb::ndarray<const uint8_t, nb::c_contig, nb::device::cpu>;

void expect(bool right, const char *what) {  // train/kernels.py has checked and explained; this guards memory
  if (!right) throw std::invalid_argument(what);
}

// Frames are some 10 MB; a training step takes one a picture, so their memory is kept for the next.
std::mutex pool_mutex;
std::vector<std::unique_ptr<spikerig::Frame>> pool;

class Render {
 public:
  Render() {
    std::lock_guard<std::mutex> lock(pool_mutex);
    if (pool.empty()) {
      frame = std::make_unique<spikerig::Frame>();
    } else {
      frame = std::move(pool.back());
      pool.pop_back();
    }
  }
  ~Render() {
    std::lock_guard<std::mutex> lock(pool_mutex);
    if (pool.size() < 16) pool.push_back(std::move(frame));
  }
  std::unique_ptr<spikerig::Frame> frame;
};

spikerig::Splats splats_of(In means, In quats, In log_scales, In logits, In sh) {
  int64_t n = static_cast<int64_t>(logits.size());
  expect(means.size() == size_t(3 * n) && quats.size() == size_t(4 * n) && log_scales.size() == size_t(3 * n),
         "splats");
  expect(sh.ndim() == 3 && int64_t(sh.shape(0)) == n && sh.shape(2) == 3, "sh");
  return {means.data(), quats.data(), log_scales.data(), logits.data(), sh.data(), n, static_cast<int>(sh.shape(1))};
}

nb::object render_forward(In means, In quats, In log_scales, In logits, In sh, InDouble camera,
                                       int width, int height, int sh_degree, bool antialias, Out image, Out alpha,
                                       Out radii) {
  expect(width > 0 && height > 0 && width <= 16384 && height <= 16384, "size");
  expect(camera.size() == 20 && image.size() == size_t(3) * width * height && alpha.size() == size_t(width) * height,
         "outputs");
  auto out = std::make_unique<Render>();
  spikerig::Frame &f = *out->frame;
  f.isa = spikerig::isa();
  f.splats = splats_of(means, quats, log_scales, logits, sh);
  expect(sh_degree >= 0 && sh_degree <= 3 && f.splats.sh_rows >= (sh_degree + 1) * (sh_degree + 1), "sh_degree");
  expect(radii.size() == size_t(f.splats.n) && f.splats.n < (int64_t(1) << 31), "radii");
  const double *c = camera.data();  // fx fy cx cy, 3 x 4, near, background
  f.camera = {c[0], c[1], c[2], c[3], {}, {}, width, height, c[16]};
  for (int k = 0; k < 12; ++k) f.camera.cam_from_world[k] = c[4 + k];
  for (int j = 0; j < 3; ++j) {
    f.camera.centre[j] = -(c[4 + j] * c[7] + c[8 + j] * c[11] + c[12 + j] * c[15]);
    f.background[j] = static_cast<float>(c[17 + j]);
  }
  f.sh_degree = sh_degree;
  f.antialias = antialias;
  f.image = image.data();
  f.alpha = alpha.data();
  bool finite = false;
  {
    nb::gil_scoped_release release;
    finite = spikerig::render_forward(f);
    for (int64_t i = 0; finite && i < f.splats.n; ++i) {
      const spikerig::Footprint &p = f.footprints.data[i];
      const spikerig::Rect &r = f.rects.data[i];
      radii.data()[i] = r.x0 == r.x1 ? 0.0f : p.reach_x > p.reach_y ? p.reach_x : p.reach_y;
    }
  }
  return finite ? nb::cast(out.release(), nb::rv_policy::take_ownership) : nb::none();
}

void render_backward(Render &render, In means, In quats, In log_scales, In logits, In sh,
                     In image_grad, In alpha_grad, Out g_means, Out g_quats, Out g_log_scales, Out g_logits, Out g_sh,
                     Out g_means2d, OutDouble g_camera, nb::object g_absgrad) {
  spikerig::Frame &f = *render.frame;
  size_t pixels = size_t(f.camera.width) * f.camera.height, n = static_cast<size_t>(f.splats.n);
  const spikerig::Splats splats = splats_of(means, quats, log_scales, logits, sh);
  expect(size_t(splats.n) == n && splats.sh_rows == f.splats.sh_rows && g_means.size() == 3 * n &&
             g_quats.size() == 4 * n && g_log_scales.size() == 3 * n && g_logits.size() == n &&
             g_sh.size() == sh.size() && g_means2d.size() == 2 * n && g_camera.size() == 12,
         "gradients");
  expect(image_grad.size() == 3 * pixels && alpha_grad.size() == pixels, "pictures");
  float *absgrad = nullptr;
  if (!g_absgrad.is_none()) {
    Out out = nb::cast<Out>(g_absgrad);
    expect(out.size() == 2 * n, "absgrad");
    absgrad = out.data();
  }
  f.splats = splats;
  f.image_grad = image_grad.data();
  f.alpha_grad = alpha_grad.data();
  nb::gil_scoped_release release;
  spikerig::render_backward(f,
                            {g_means.data(), g_quats.data(), g_log_scales.data(), g_logits.data(), g_sh.data(),
                             g_means2d.data(), absgrad},
                            g_camera.data());
}

double l1_ssim(In image, In target, nb::object valid, nb::object grad, double l1_scale, double ssim_scale) {
  expect(image.ndim() == 3 && image.shape(2) == 3 && image.size() == target.size() && image.size() > 0, "pictures");
  spikerig::SsimPlan plan{};
  plan.image = image.data(), plan.target = target.data();
  plan.height = static_cast<int>(image.shape(0)), plan.width = static_cast<int>(image.shape(1));
  plan.l1_scale = l1_scale, plan.ssim_scale = ssim_scale;
  if (!valid.is_none()) {
    Mask mask = nb::cast<Mask>(valid);
    expect(3 * mask.size() == image.size(), "valid");
    plan.valid = mask.data();
  }
  if (!grad.is_none()) {
    Out out = nb::cast<Out>(grad);
    expect(out.size() == image.size(), "grad");
    plan.grad = out.data();
  }
  nb::gil_scoped_release release;
  return spikerig::l1_ssim(plan);
}

}  // namespace

void bind_train(nb::module_ &m) {
  nb::set_leak_warnings(false);  // a graph alive at exit keeps its Render; that is no leak
  nb::class_<Render>(m, "Render", "One picture's lists and footprints, kept from forward to backward.")
      .def_prop_ro("width", [](const Render &r) { return r.frame->camera.width; }, "Pixels.")
      .def_prop_ro("height", [](const Render &r) { return r.frame->camera.height; }, "Pixels.")
      .def_prop_ro("pairs", [](const Render &r) { return r.frame->pairs; }, "(tile, splat) pairs.")
      .def_prop_ro("visible", [](const Render &r) { return r.frame->visible; }, "Splats not culled.")
      .def("consulted", [](const Render &r) { return spikerig::consulted(*r.frame); },
           "Sum over pixels of listed splats up to where the pixel was finished (slow, for benchmarks).");
  m.def("render_forward", &render_forward, "means"_a, "quats"_a, "log_scales"_a, "logits"_a, "sh"_a, "camera"_a,
        "width"_a, "height"_a, "sh_degree"_a, "antialias"_a, "image"_a, "alpha"_a, "radii"_a,
        "camera: fx fy cx cy, cam_from_world[12], near, background[3]. None when a parameter is not finite.");
  m.def("render_backward", &render_backward, "render"_a, "means"_a, "quats"_a, "log_scales"_a, "logits"_a, "sh"_a,
        "image_grad"_a, "alpha_grad"_a, "g_means"_a, "g_quats"_a, "g_log_scales"_a, "g_logits"_a,
        "g_sh"_a, "g_means2d"_a, "g_camera"_a, "g_absgrad"_a.none(),
        "Gradients of the picture render_forward drew; g_absgrad: sums over pixels of |d loss / d means2d|, or None.");
  m.def("l1_ssim", &l1_ssim, "image"_a, "target"_a, "valid"_a.none(), "grad"_a.none(), "l1_scale"_a, "ssim_scale"_a,
        "l1_scale * sum |image - target| + ssim_scale * sum (1 - ssim) over valid channels; grad is written.");
}
