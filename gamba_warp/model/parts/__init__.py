"""Parts of the network: tokens, patches, blocks, decoders."""
