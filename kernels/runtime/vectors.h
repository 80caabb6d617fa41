typedef float F __attribute__((vector_size(64), aligned(4)));
typedef int I __attribute__((vector_size(64), aligned(4)));
auto splat = [](float x) -> F { return (F){x, x, x, x, x, x, x, x, x, x, x, x, x, x, x, x}; };
