# How the native modules are watched: warnings, and the sanitizers of `make sanitize`.

# Warnings of one of our targets. nanobind's own sources are not ours to keep clean.
function(checked target)
  target_compile_options(${target} PRIVATE -Wall -Wextra)
  if(ROBOT_GST_WERROR)
    target_compile_options(${target} PRIVATE -Werror)
  endif()
endfunction()

# For every target that is made from here on, nanobind's too: what it hands us is watched as well.
if(ROBOT_GST_SANITIZE)
  set(sanitizers -fsanitize=address,undefined,float-cast-overflow)
  add_compile_options(${sanitizers} -fno-sanitize-recover=all -fno-omit-frame-pointer -g1)
  add_link_options(${sanitizers})
  # Python takes the modules of this folder where PYTHONPATH names it.
  configure_file(${CMAKE_CURRENT_LIST_DIR}/sanitized_finder.py.in sitecustomize.py @ONLY)
endif()
