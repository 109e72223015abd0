from cgid.export.c99 import c_source as c_source
