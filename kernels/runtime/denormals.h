// Until it goes out of scope, numbers below 2^-126 count as 0: a state that decays towards zero
// passes through them, which slows x86 down a hundredfold.
namespace gamba {

struct FlushDenormals {
#if defined(__x86_64__)
    const unsigned before = __builtin_ia32_stmxcsr();
    FlushDenormals() { __builtin_ia32_ldmxcsr(before | 0x8040); }
    ~FlushDenormals() { __builtin_ia32_ldmxcsr(before); }
#endif
};

}  // namespace gamba
