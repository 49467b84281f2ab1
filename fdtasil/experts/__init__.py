"""Who is asked: everything that answers observations with actions becomes one `Expert`.

`load` opens whatever an argument may be, `expert` is the counted black box that comes of it, and
`gate` looks at its answers before anything is spent on it.
"""
