"""Messages of the link, put in order and counted; pure but for `group`.

`receiver` takes all of one edge, `reassemble` makes its video decodable, `reception` accounts for what came of one
session: what is missing, how old it is. `group` shares edges among grounds.
"""
