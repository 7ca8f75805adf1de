"""Files and folders in object storage, by URI (obstore; the extra `fleet`).

`remote` names them, `objects` reads and writes them, `stream` reads parts of one, `folders` copies whole ones.
"""
