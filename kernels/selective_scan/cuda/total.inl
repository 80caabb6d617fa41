// The sums for dB and dC after reverse.inl, where that has not made them state block by block.
// Apart from it, so that loads can be on their way meanwhile that would cost the walk registers.
#include "shape.h"
#include "total.h"
if constexpr (WALKS == 1 && (NEED_DB || NEED_DC)) total_(0);
