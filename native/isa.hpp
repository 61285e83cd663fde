// Which instruction set the kernels use: the best this CPU has, unless forced.
#pragma once
#include <string>
#include <vector>

namespace spikerig {

enum class Isa : int { plain = 0, avx2 = 1, avx512 = 2 };

Isa isa();                              // in use now; first call reads SPIKERIG_ISA
void set_isa(const std::string &name);  // throws std::invalid_argument when this CPU or build lacks it
std::string isa_name(Isa which);
std::vector<std::string> isas();        // usable here, worst first

}  // namespace spikerig
