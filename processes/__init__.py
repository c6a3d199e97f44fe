"""What runs: the node contract, the executors, the process table, the processes."""
