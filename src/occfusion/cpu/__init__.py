"""What the package asks of the machine: threads, workers, processes, memory, compilation."""
