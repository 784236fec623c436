"""stub"""
def markdown(o): return str([ (p["part"],p["state"],p["seconds"],p.get("error"),p.get("traceback","")[-900:]) for p in o["parts"]]).replace("), (","),\n(")
