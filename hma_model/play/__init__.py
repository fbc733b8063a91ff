"""Serve `hma play`: a web page on which people drive a world model or a simulator."""
