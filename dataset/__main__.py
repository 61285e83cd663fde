"""`python -m spikerig.dataset` is `spikerig`: what child processes run, whatever the PATH says."""

from spikerig.dataset.cli import main

main()
