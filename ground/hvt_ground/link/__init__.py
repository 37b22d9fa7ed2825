"""Messages of the link, put in order and counted; pure but for `group`.

`receiver` takes all of one edge, `reassemble` makes its video decodable, `statistics` says what is missing
and when pictures were captured. `group` shares edges among grounds.
"""
