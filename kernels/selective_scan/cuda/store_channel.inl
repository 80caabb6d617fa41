// One element of a tensor [B, L, D].
char* at = (char*)((ELEMENT*)x_out.data + d) + wide_(b, x_out.strides[0]);
at += wide_(t, x_out.strides[1]);
*(ELEMENT*)at = (ELEMENT)v;
