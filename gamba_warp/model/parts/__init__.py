"""The parts of the network: tokens, patches, blocks, decoders."""
