#include <nanobind/nanobind.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "isa.hpp"
#include "team.hpp"

namespace nb = nanobind;

void bind_spikes(nb::module_ &m);
void bind_events(nb::module_ &m);
void bind_train(nb::module_ &m);
void bind_light(nb::module_ &m);
void bind_fields(nb::module_ &m);

NB_MODULE(_native, m) {
  m.doc() = "spikerig's native kernels. Call them through dataset.kernels and train.kernels, which check shapes.";
  m.def("isa", [] { return spikerig::isa_name(spikerig::isa()); }, "Instruction set in use: plain, avx2 or avx512.");
  m.def("set_isa", &spikerig::set_isa, nb::arg("name"), "Force an instruction set this CPU has.");
  m.def("isas", &spikerig::isas, "Instruction sets usable on this CPU, worst first.");
  m.def("threads", &spikerig::threads, "Size of the kernels' thread team.");
  m.def("set_threads", &spikerig::set_threads, nb::arg("n"), "Set the thread team's size (1..256).");
  bind_spikes(m);
  bind_events(m);
  bind_train(m);
  bind_light(m);
  bind_fields(m);
}
