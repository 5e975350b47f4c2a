"""Shadow matting and compositing after Chuang et al., SIGGRAPH 2003."""

__version__ = "0.3.0"
