"""Put bytes where they last: files written whole or not at all, stores behind fsspec URIs, retries, caches.

In come paths and URIs, out go bytes and paths. The packages after it never open a remote file themselves.
Next: `hma_data.hub`, repositories of the Hugging Face Hub.
"""
