namespace spikerig::SPIKERIG_ISA { void nothing() {} }
