"""How often the diagnosis is right, and how small an effect may be: recordings with something hidden in them."""
