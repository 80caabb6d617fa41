"""Basis of every operator: views of tensors, launches, threads, memory, SIMD."""
