"""Laws of runs with faults, simulated or of real processes: `table` has all of them.

A scenario says what controller, network, disk and processes do; its run leaves `evidence`; the laws
of `table` whose part of the evidence is there judge it. A law is a function that yields a sentence
for each violation. What it reads is decoded independently of the product where that is possible
(`second_reader`, `manifests`). Laws of what one source of scenarios alone observes, as each packet
on a simulated wire, stand beside it and are entries of the same table. Session and guard are judged
by `tests.drivers.judge`, packets by its `oracle`.
"""
