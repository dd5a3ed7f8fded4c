"""Pure numbers: arrays in, arrays out; no files, no coordinate systems."""
