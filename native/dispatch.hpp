// DISPATCH(count, args...) calls plain::count, avx2::count or avx512::count, whichever isa() says.
#pragma once
#include "isa.hpp"

#if defined(__x86_64__)
#define SPIKERIG_EACH_ISA(X) X(plain) X(avx2) X(avx512)
#define DISPATCH(name, ...)                                                        \
  (::spikerig::isa() == ::spikerig::Isa::avx512 ? ::spikerig::avx512::name(__VA_ARGS__) \
   : ::spikerig::isa() == ::spikerig::Isa::avx2 ? ::spikerig::avx2::name(__VA_ARGS__)   \
                                                : ::spikerig::plain::name(__VA_ARGS__))
#else
#define SPIKERIG_EACH_ISA(X) X(plain)
#define DISPATCH(name, ...) ::spikerig::plain::name(__VA_ARGS__)
#endif
