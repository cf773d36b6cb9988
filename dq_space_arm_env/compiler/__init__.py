"""From functions over plain scalars to machine code; knows no robot.

`graph` traces, `program` chains graphs, `emit` and `elementary` write LLVM with `vector_builder`, `build`
compiles the loop over rows, and `native` caches and loads the result.
"""
