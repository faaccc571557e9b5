def fill(text, entries): return text
