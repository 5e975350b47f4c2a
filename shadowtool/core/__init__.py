"""The paper's ideas, one module each: arrays in, arrays out."""
