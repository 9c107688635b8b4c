"""From a wrench to what was touched: the tool's weight, the onset, and where the force enters the peg."""
