"""Kinds of files that hold a function.

One file here for each, with `ENDING` of its name, `LIBRARIES` that it needs beside what is always
there, and three functions: `content(function)` is the file; `outputs(content, function)` reads it
back and runs it on the cases of the function; `facts(content, function)` is what export.json says
of it.
"""
