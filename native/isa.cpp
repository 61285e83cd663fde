#include "isa.hpp"

#include <atomic>
#include <cstdlib>
#include <stdexcept>

namespace spikerig {
namespace {

bool usable(Isa which) {
  if (which == Isa::plain) return true;
#if defined(__x86_64__)
  __builtin_cpu_init();
  if (which == Isa::avx2)
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2");
  return usable(Isa::avx2) && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
         __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl");
#else
  return false;
#endif
}

Isa named(const std::string &name) {
  for (Isa which : {Isa::plain, Isa::avx2, Isa::avx512})
    if (isa_name(which) == name) {
      if (!usable(which)) throw std::invalid_argument("this CPU or build has no " + name + " kernels");
      return which;
    }
  throw std::invalid_argument("unknown instruction set '" + name + "': plain, avx2 or avx512");
}

Isa first() {
  if (const char *forced = std::getenv("SPIKERIG_ISA"))
    if (*forced) return named(forced);
  for (Isa which : {Isa::avx512, Isa::avx2})
    if (usable(which)) return which;
  return Isa::plain;
}

std::atomic<int> current{-1};

}  // namespace

Isa isa() {
  int now = current.load(std::memory_order_relaxed);
  if (now < 0) {
    now = static_cast<int>(first());
    current.store(now);
  }
  return static_cast<Isa>(now);
}

void set_isa(const std::string &name) { current.store(static_cast<int>(named(name))); }

std::string isa_name(Isa which) {
  return which == Isa::avx512 ? "avx512" : which == Isa::avx2 ? "avx2" : "plain";
}

std::vector<std::string> isas() {
  std::vector<std::string> out;
  for (Isa which : {Isa::plain, Isa::avx2, Isa::avx512})
    if (usable(which)) out.push_back(isa_name(which));
  return out;
}

}  // namespace spikerig
