// One element of a tensor [B, L, D] from its channel's origin.
char* at = (char*)origin;
__builtin_assume(__isGlobal(at));
at += wide_(t, x_out.strides[1]);
const ELEMENT rounded = (ELEMENT)v;
if (inside) *(ELEMENT*)at = rounded;
