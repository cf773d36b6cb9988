"""From functions over plain scalars to machine code; knows no robot.

`graph` traces, `emit` and `elementary` write LLVM, `program` strings graphs together and loops over rows,
`build` compiles, and `native` keeps and loads the result.
"""
