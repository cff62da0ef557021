"""The live loop: devices read in threads, recorded, merged in ticks, estimated and shown."""
