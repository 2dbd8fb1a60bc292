# What the ROS wheels on PyPI need beyond a ROS installation.

# The ROS wheels on PyPI export include folders of the machine that built them, and CMake stops on a
# folder that does not exist.  On a ROS installation every folder exists and nothing is dropped.
function(drop_missing_include_directories)
  foreach(target IN LISTS ARGN)
    get_target_property(folders ${target} INTERFACE_INCLUDE_DIRECTORIES)
    if(folders)
      set(kept)
      foreach(folder IN LISTS folders)
        if(EXISTS "${folder}" OR folder MATCHES "\\$<")
          list(APPEND kept "${folder}")
        endif()
      endforeach()
      set_target_properties(${target} PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${kept}")
    endif()
  endforeach()
endfunction()

# Of every package that has been found so far.
macro(mend_ros_wheels)
  get_property(imported DIRECTORY PROPERTY IMPORTED_TARGETS)
  drop_missing_include_directories(${imported})
endmacro()

# rosidl exports numpy's include folder, and CMake refuses to export a folder inside the source tree,
# where `make setup` keeps its virtual environment.  Nobody links against this target from outside.
function(mend_python_export package source)
  set(target ${package}__rosidl_generator_py)
  get_target_property(folders ${target} INTERFACE_INCLUDE_DIRECTORIES)
  list(FILTER folders EXCLUDE REGEX "^${source}/")
  set_target_properties(${target} PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${folders}")
endfunction()

# The many small C++ files of a package's type support include the same large headers: merged to one file each, they
# compile in a quarter of the time.  The sources in C repeat names and stay apart.
function(merge_typesupport_sources package)
  foreach(kind IN ITEMS cpp introspection_cpp fastrtps_c fastrtps_cpp)
    if(TARGET ${package}__rosidl_typesupport_${kind})
      set_target_properties(
        ${package}__rosidl_typesupport_${kind} PROPERTIES UNITY_BUILD ON UNITY_BUILD_BATCH_SIZE 0)
    endif()
  endforeach()
endfunction()
