"""The page that anyone opens: the live picture, stills and events of all edges in a browser.

A sink (`feed`) turns each session into messages, `viewers` gives them out, `site` lists the requests, and
`server` runs it. The pages' own files are in ``static``: ``main.js`` lists tracks and stills, ``words.js`` has their
words, of the facts that `feed` sends of each.
"""
