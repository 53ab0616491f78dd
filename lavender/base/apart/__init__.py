"""Other Pythons that run code which is not ours: asked by messages, answering with data, ended with what they started.

`process` is the asking side, `served` the answering one; `lines` asks a program of another language from within such
a process.
"""
