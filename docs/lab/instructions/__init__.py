"""Instructions of the CUDA kernels by a disassembler: ``make instructions``."""
