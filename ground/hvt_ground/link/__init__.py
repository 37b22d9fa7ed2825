"""Messages of the link, put in order and counted; pure.

`receiver` takes all of one edge, `reassemble` makes its video decodable, `reception` keeps the account of one
session: bytes, losses, ages. `group`: edges that grounds share.
"""
