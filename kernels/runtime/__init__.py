"""What every operator stands on: views of tensors, launches, threads, memory, SIMD."""
