#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include "dispatch.hpp"

namespace nb = nanobind;

void bind_train(nb::module_ &m) { (void)m; }
