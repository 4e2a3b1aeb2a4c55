"""Ready column maps of common logs; `hil import maps` lists them."""
