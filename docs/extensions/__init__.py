"""What the documentation is made with: pages from what the program uses itself; formulas as MathML."""
