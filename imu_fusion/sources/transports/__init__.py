"""How bytes come here: files, archives, ports and the network. Nothing here knows a format."""
