"""Sound sample files of every format, small and made on the fly: what mutations begin with."""
