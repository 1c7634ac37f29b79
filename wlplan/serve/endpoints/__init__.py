"""The endpoints: one module for each, which nothing else names.

Each has `METHOD`, `PATH` as Starlette writes them, and
`async def answer(service, request)`, which returns a response or raises an `InputError`.
"""
