// A fixed team of threads. Work is cut into `parts` numbered pieces that do not depend on the team's size,
// so a kernel that gives each piece its own output (or reduces pieces in number order) returns the same
// bits for any thread count.
#pragma once
#include <functional>

namespace spikerig {

int threads();             // team size, at least 1; first call reads SPIKERIG_THREADS, else the CPUs we may use
void set_threads(int n);   // 1..256, std::invalid_argument otherwise
void parallel(int parts, const std::function<void(int part)> &work);  // returns when every part is done

}  // namespace spikerig
