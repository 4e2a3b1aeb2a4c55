"""Laws of campaigns with faults, simulated or of real processes.

A law is a function that yields a sentence for each violation. What it reads is decoded
independently of the product where that is possible (`second_reader`, `manifests`).
`tests.simulate`, `tests.process_death`, `tests.disk`, `tests.fault_matrix` and `tests.endurance`
check those whose input they have; laws of what only one observes, as each packet on a simulated
wire, stand there. Session and guard are judged by `tests.drivers.judge`, packets by its `oracle`.
"""
