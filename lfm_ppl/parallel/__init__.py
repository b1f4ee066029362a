"""Many computations as tasks: stored one by one, in this process, in others, or on the machines of a cluster."""
