"""The tables and figures: one file each; `run` writes numbers, `draw` reads them."""
